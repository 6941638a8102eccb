"""Delivery: queues, accounts, acknowledgements and flow control."""
