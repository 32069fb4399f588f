"""Speed: settling, throughput, learner, kernels."""
