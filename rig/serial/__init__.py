"""Bytes to messages and back: the serial port, framing and the rig's protocol."""
