"""What goes in and out on disk: sessions and results."""
