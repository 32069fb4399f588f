"""Pictures of the arm and of its workspace."""
