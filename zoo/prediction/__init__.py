"""One answer for every model: a mixture, its marginals, its labels and units."""
