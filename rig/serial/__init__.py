"""Bytes to messages and back: ``port.Port``, and the lines and messages of ``protocol``."""
