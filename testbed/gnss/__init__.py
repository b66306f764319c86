"""GNSS down to the satellites: constellations, signals and their errors, tracking, and the receiver that makes fixes of them.

`testbed.gnss.sense` records a flight; the modules beside it hold one part each, with its sources. Frames: e (Earth-fixed),
n (north-east-down), b. SI units and radians; C/N0 in dB-Hz; time is GPS time in seconds from the start of the flight.
"""
