"""What knows no mechanics: small linear algebra in scalars, what XLA needs, parameters with range and unit, files."""
