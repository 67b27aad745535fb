"""A running robot and a running camera: frames as they come, and recordings of them."""
