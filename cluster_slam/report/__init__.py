"""Pages and figures that show a result."""
