"""Stream health, computed from samples: rates, gaps, flags and ages."""
