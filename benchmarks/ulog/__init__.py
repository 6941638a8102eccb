"""Reading ULog files, and receiving the ULog stream."""
