"""The three nouns of the bench, sensor specifications, table columns, and what the bench asks of an estimator."""
