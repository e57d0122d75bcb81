"""The batch MAP over all raw measurements, which no team can beat."""
