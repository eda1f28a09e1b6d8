"""Infrastructure without mechanics: linear algebra in scalars, compilation, parameters with ranges, errors, files."""
