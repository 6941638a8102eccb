"""Readers that compute or are stuck, beside healthy ones."""
