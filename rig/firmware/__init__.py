"""What runs on the device: the Arduino sketch, and ``reference.DeviceCore``, the same in Python."""
