"""Events of a flight, with a fake clock."""
