/* Runs of the page. The scenes' code precedes this file; SCENE(NAME) defines the functions of one scene. */
enum { SAMPLES = 4001, MOST_STATES = 3 };
/* One row each: position, velocity, friction force, bristle. */
static double runs[3][SAMPLES][MOST_STATES], shown[4][SAMPLES];

double *results(void) { return &shown[0][0]; }

#define SCENE(NAME)                                                                            \
  static double NAME##_p[NAME##_P];                                                            \
  double *NAME##_arguments(void) { return NAME##_p; }                                          \
  /* Largest estimated error of the positions [m], or -1 where a step was not solved. */       \
  double NAME##_simulate(double duration) {                                                    \
    const int last = SAMPLES - 1;                                                              \
    double error = 0;                                                                          \
    for (int level = 0; level < 3; ++level) {                                                  \
      const int steps = 1 << level; /* between two samples */                                  \
      double y[NAME##_Y];                                                                      \
      for (int k = 0; k < NAME##_Y; ++k) y[k] = NAME##_rest[k];                                \
      for (int i = 0;; ++i) {                                                                  \
        for (int k = 0; k < NAME##_Y; ++k) runs[level][i][k] = y[k];                           \
        if (i == last) break;                                                                  \
        const double t = duration * i / last, h = duration / last / steps;                     \
        if (!NAME##_run(t, h, steps, NAME##_p, y)) return -1;                                  \
      }                                                                                        \
    }                                                                                          \
    for (int i = 0; i < SAMPLES; ++i) {                                                        \
      double y[NAME##_Y], force[1];                                                            \
      /* The error of a step is of the first order: half the step has half of it. */           \
      for (int k = 0; k < NAME##_Y; ++k) y[k] = 2 * runs[2][i][k] - runs[1][i][k];             \
      error = fmax(error, fabs(y[0] - (2 * runs[1][i][0] - runs[0][i][0])));                   \
      const double t = duration * i / last;                                                    \
      shown[0][i] = y[0], shown[1][i] = y[1], shown[3][i] = NAME##_Y > 2 ? y[NAME##_Y - 1] : 0; \
      NAME##_friction(t, t, NAME##_p, y, force); /* over no time: the force in this state */   \
      shown[2][i] = force[0];                                                                  \
    }                                                                                          \
    return error;                                                                              \
  }
