"""Pictures of the simulated plant: colour and depth as a small RGB-D camera would give them."""
