"""Many runs: the runner, its unit of work, where it is computed, what is kept, sweeps and comparisons."""
