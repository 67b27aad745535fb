"""Descriptors held against each other."""
