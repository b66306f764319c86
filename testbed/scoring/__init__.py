"""Scoring: what is measured of a solution (`quantities`)."""
