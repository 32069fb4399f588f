"""The paper's experiments on digital twins."""
