"""What is measured: run them with `make bench`."""
