"""The decision process: action, observation and reward, alike in training and on an arm. NumPy and JAX."""
