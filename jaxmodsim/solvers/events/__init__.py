"""Events inside one `diffeqsolve`: the solver, its controller and the guards."""
