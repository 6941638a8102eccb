"""Readers that are busy or stuck, next to healthy ones."""
