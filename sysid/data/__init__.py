"""What the data can and cannot say, before any fit."""
