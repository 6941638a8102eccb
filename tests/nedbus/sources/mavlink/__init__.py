"""Tests of the MAVLink source and the ULog stream."""
