"""Constellations: how a plant changes over days, and matching of whole constellations without any prior on the pose."""
