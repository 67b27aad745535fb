"""Sensors: the camera model and, where they are attached, robots and live cameras."""
