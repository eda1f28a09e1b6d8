"""How sure the numbers are: covariance, the result of a fit, profiles, tests of residuals, coverage."""
