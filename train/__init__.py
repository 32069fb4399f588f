"""Training jobs for the soft arm: agents, replay, rollouts. Run from the checkout, not part of the wheel."""
