"""Codes of the instances of a class: their penalty, and their inference from views."""
