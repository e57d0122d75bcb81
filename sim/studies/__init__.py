"""Studies: experiments and the batch reference. The product runs without this folder."""
