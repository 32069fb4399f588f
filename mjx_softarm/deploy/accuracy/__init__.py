"""Accuracy of a policy on an arm, what makes its error, and lines that tell both. NumPy only."""
