"""Subscriptions: queues, recovery, rates and counts."""
