"""The simulated flight: `sim:`, the same seed gives the same messages, to the bit."""
