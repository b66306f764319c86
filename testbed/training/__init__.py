"""Flights and data sets for estimators that learn."""
