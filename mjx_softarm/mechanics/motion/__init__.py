"""Arms in motion: their state, and the engines that move them under the sensor-space law."""
