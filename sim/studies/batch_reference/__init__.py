"""The batch MAP over all raw readings, which no team can beat."""
