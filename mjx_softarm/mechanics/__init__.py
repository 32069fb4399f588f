"""The arm as physics: its model, its rest, its motion, its pictures."""
