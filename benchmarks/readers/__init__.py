"""Readers that are busy or stuck, alongside healthy ones."""
