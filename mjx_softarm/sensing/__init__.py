"""Sensing: readings of the springs to their lengths, and lengths to the pose of the tip."""
