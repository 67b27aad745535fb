"""A map that remembers: which plant this is, who is who, and what the session changes."""
