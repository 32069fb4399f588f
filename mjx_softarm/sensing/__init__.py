"""From readings of the springs to their lengths, and from these to the pose of the tip."""
