"""The paper's experiments on simulated stand-ins for an arm, and its claims."""
