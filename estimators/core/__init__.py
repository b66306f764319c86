"""The error-state filter from parts: numbers side by side, error model, covariance, updates, and one time line for all filters."""
