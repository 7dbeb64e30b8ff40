"""State and disturbance estimates from readings, and checks of the readings."""
