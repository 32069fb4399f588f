"""What a calibration finds of an arm, and how well payloads are told with it."""
