"""A simulated bramble plant, the arm that looks at it, and all that goes wrong."""
