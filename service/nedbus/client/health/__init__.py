"""The health of streams, from their samples: rates, gaps, flags, ages."""
