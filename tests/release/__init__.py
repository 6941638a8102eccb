"""What a release is: its public API, its locked dependencies, and who answers for its security."""
