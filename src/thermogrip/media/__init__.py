"""What every room renders: text for any medium, panels of figures, results in a few lines."""
