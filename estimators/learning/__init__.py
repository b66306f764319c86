"""Estimators that learn, their networks and shipped weights."""
