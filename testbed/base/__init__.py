"""What everything may use: errors, random streams, resources, checked settings, files, child processes."""
