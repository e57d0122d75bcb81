"""Other people's logs → data sets in folders of CSV tables."""
