"""Movement data: records, splits, scaling, readers and the library of data sets by name."""
