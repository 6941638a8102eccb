"""Reading and serving ULog files, and receiving the ULog stream."""
