"""From a request to a run folder, and from many runs to a comparison."""
