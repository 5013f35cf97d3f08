"""An instrument: a foundation model simulated from recorded depth and poses, never a default."""
