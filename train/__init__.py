"""Training jobs for the soft arm: agents, replay, rollouts."""
