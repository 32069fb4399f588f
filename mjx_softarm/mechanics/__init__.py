"""The arm as physics: model, equilibrium, motion, pictures."""
