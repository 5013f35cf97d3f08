"""Settings and methods compared over sequences and seeds."""
