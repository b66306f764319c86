"""Recorded data in, flights out."""
from testbed.formats.recording import Recording
