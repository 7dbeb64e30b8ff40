"""Free runs on logs that were not fitted: errors, bands, and what the residuals still correlate with."""
