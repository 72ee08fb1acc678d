"""Optimisers of groups of parameters: Adam, its masked form, and Muon."""
