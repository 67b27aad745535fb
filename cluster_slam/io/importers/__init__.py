"""Recordings of other programs as sessions: one file a format."""
