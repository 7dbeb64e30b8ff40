"""What runs on the device: the Arduino sketch, and its reference in Python."""
