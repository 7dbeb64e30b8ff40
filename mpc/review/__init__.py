"""Design review: checks of a controller before it meets the rig."""
