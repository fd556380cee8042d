"""Procedural objects and light for the truth scenes in scenes/targets."""
