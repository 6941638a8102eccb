"""Tests of positions that are sent into a vehicle: the decision, the link, and a PX4 that receives them."""
