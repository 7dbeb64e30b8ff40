"""The plant at the controller's sample time: prediction, linearisation, steady states."""
