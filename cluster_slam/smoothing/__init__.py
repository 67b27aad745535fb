"""The stages of smoothing a session whose associations nobody told."""
