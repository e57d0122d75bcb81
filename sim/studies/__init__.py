"""Studies: experiments and the batch reference; the product runs without."""
