"""Events of a flight, by the clock of the test."""
