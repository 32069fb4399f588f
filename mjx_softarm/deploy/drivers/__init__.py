"""Arms by name, and drivers for hardware: a serial line, LDC1612 converters, a microcontroller's firmware."""
