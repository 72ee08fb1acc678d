"""What a fit optimises for each training view besides its pose."""
