/* Motion of a scene by Rodas5P with error control; steps end on events, which are located on the steps themselves. */
#include "motion.h"
#include <float.h>
#include <math.h>
#include <string.h>

/* Largest distance of the end of a step from an event, in steps, and in intervals since the last event. */
#define LANDING 1e-5
#define LANDING_OF_INTERVAL 1e-2
/* A function that rises from this close to zero, in steps, has been positive. */
#define ZERO 1e-3
/* Events accumulate if the last intervals are below this part of the time since the start, and there are that many. */
#define ACCUMULATION 1e-3
#define FEWEST 8
#define FORGET 0.05
/* A step ends on a root behind this fraction of it. */
#define ENDS 0.99
/* Attempts that are repeated because guards are not resolved. */
#define DOUBTS 12
#define TRIALS 200

static double larger(double a, double b) { return a > b ? a : b; }
static double smaller(double a, double b) { return a < b ? a : b; }
static double within(double low, double x, double high) { return x < low ? low : x > high ? high : x; }
static double resolution(const State *s) { return 4.0 * DBL_EPSILON * larger(fabs(s->t), fabs(s->begin)); }

void motion_reset(Motion *c) {
  State *s = &c->s;
  memset(c, 0, sizeof *c);
  memcpy(s->numbers, model_numbers, sizeof model_numbers);
  memcpy(s->y, model_states, sizeof model_states);
  s->rtol = RTOL, s->atol = ATOL;
}

void motion_tolerances(Motion *c) {
  c->tolerances[0] = 1e-3 * c->s.atol, c->tolerances[1] = c->s.rtol, c->tolerances[2] = c->s.atol;
}

double motion_project(Motion *c, double y[STATES]) {
  double distance = 0.0;
  (void)c, (void)y;
#if PROJECTS
  double before[STATES];
  memcpy(before, y, sizeof before);
  model_project(c->s.t, c->s.numbers, c->s.mode, y);
  for (int i = 0; i < STATES; ++i) {
    distance = larger(distance, fabs(y[i] - before[i]) / (c->s.atol + c->s.rtol * fabs(y[i])));
  }
#endif
  return distance;
}

int motion_admits(Motion *c) {
  (void)c;
#if RANGES
  double holds[RANGES];
  model_ranges(c->s.numbers, holds);
  for (int i = 0; i < RANGES; ++i) {
    if (holds[i] == 0.0) return c->failure = model_requirements[i], 0;
  }
#endif
  return 1;
}

int motion_start(Motion *c) {
  State *s = &c->s;
  if (!motion_admits(c)) return 0;
  model_start(s->t, s->numbers, c->tolerances, s->y, s->mode);
  memset(s->waits, 0, sizeof s->waits);
  s->changed = s->pending = 0, s->back = 0.0;
  c->linearised = 0;
  return 1;
}

/* ---- steps ---- */

static void linearise(Motion *c) {
  if (!c->linearised) model_linear(c->s.t, c->s.numbers, c->s.y, c->s.mode, c->linear);
  c->linearised = 1;
}

/* LU factors of shift I - J, with rows swapped. */
static void factor(Motion *c, double shift) {
  const double *jacobian = c->linear + 2 * STATES;
  double(*a)[STATES] = c->factors;
  for (int i = 0; i < STATES; ++i) {
    for (int j = 0; j < STATES; ++j) a[i][j] = (i == j ? shift : 0.0) - jacobian[i * STATES + j];
  }
  for (int k = 0; k < STATES; ++k) {
    int best = k;
    for (int i = k + 1; i < STATES; ++i) best = fabs(a[i][k]) > fabs(a[best][k]) ? i : best;
    c->rows[k] = best;
    for (int j = 0; j < STATES && best != k; ++j) {
      const double x = a[k][j];
      a[k][j] = a[best][j], a[best][j] = x;
    }
    for (int i = k + 1; i < STATES; ++i) {
      if (a[i][k] == 0.0) continue;
      a[i][k] /= a[k][k];
      for (int j = k + 1; j < STATES; ++j) a[i][j] -= a[i][k] * a[k][j];
    }
  }
}

static void solve(const Motion *c, double x[STATES]) {
  for (int k = 0; k < STATES; ++k) {
    const double top = x[c->rows[k]];
    x[c->rows[k]] = x[k], x[k] = top;
  }
  for (int i = 1; i < STATES; ++i) {
    for (int j = 0; j < i; ++j) x[i] -= c->factors[i][j] * x[j];
  }
  for (int i = STATES - 1; i >= 0; --i) {
    for (int j = i + 1; j < STATES; ++j) x[i] -= c->factors[i][j] * x[j];
    x[i] /= c->factors[i][i];
  }
}

/* A step of the length h from the state to `end`, and its error in tolerances. */
static double attempt(Motion *c, double h) {
  const State *s = &c->s;
  const double *rate = c->linear, *by_time = c->linear + STATES;
  double f[STATES], y[STATES], sum = 0.0;
  linearise(c);
  factor(c, 1.0 / (GAMMA * h));
  for (int i = 0; i < 8; ++i) {
    if (i == 0) memcpy(f, rate, sizeof f);
    else {
      memcpy(y, s->y, sizeof y);
      for (int j = 0; j < i; ++j) {
        for (int n = 0; n < STATES; ++n) y[n] += STAGE[i][j] * c->stage[j][n];
      }
      model_rate(s->t + NODE[i] * h, s->numbers, y, s->mode, f);
    }
    for (int n = 0; n < STATES; ++n) f[n] += h * TIME[i] * by_time[n];
    for (int j = 0; j < i; ++j) {
      for (int n = 0; n < STATES; ++n) f[n] += COUPLING[i][j] / h * c->stage[j][n];
    }
    solve(c, f);
    memcpy(c->stage[i], f, sizeof f);
  }
  for (int n = 0; n < STATES; ++n) c->raw[n] = y[n] + c->stage[7][n];
  for (int r = 0; r < 3; ++r) {
    for (int n = 0; n < STATES; ++n) {
      c->dense[r][n] = 0.0;
      for (int j = 0; j < 8; ++j) c->dense[r][n] += DENSE[r][j] * c->stage[j][n];
    }
  }
  memcpy(c->end, c->raw, sizeof c->end);
#if PROJECTS
  model_project(s->t + h, s->numbers, s->mode, c->end);
#endif
  for (int n = 0; n < STATES; ++n) {
    const double scale = s->atol + s->rtol * larger(fabs(s->y[n]), fabs(c->end[n]));
    const double error = (fabs(c->stage[7][n]) + fabs(c->end[n] - c->raw[n])) / scale;
    sum += error * error;
  }
  return isfinite(sum) ? sqrt(sum / STATES) : INFINITY;
}

static void first_step(Motion *c) {
  double size = 0.0, rate = 0.0;
  linearise(c);
  for (int n = 0; n < STATES; ++n) {
    const double scale = c->s.atol + c->s.rtol * fabs(c->s.y[n]);
    size += c->s.y[n] / scale * (c->s.y[n] / scale), rate += c->linear[n] / scale * (c->linear[n] / scale);
  }
  size = sqrt(size / STATES), rate = sqrt(rate / STATES);
  c->s.step = size > 1e-5 && rate > 1e-5 ? 0.01 * size / rate : 1e-6;
}

#if MODES
/* Dense output at the fraction `part` of the last attempt. */
static void state_at(const Motion *c, double part, double y[STATES]) {
  const double left = 1.0 - part;
  for (int n = 0; n < STATES; ++n) {
    const double curve = c->dense[0][n] + part * (c->dense[1][n] + part * c->dense[2][n]);
    y[n] = left * c->s.y[n] + part * (c->raw[n] + left * curve);
  }
}

/* Guards in dense output: values, tolerances, and values at events. */
static void guards_at(const Motion *c, double h, double part, double g[3 * MODES]) {
  double y[STATES];
  state_at(c, part, y);
  model_guards(c->s.t + part * h, c->s.numbers, y, c->s.mode, c->tolerances, g);
}

/* Guard i above its value at an event. */
static double above(const double g[3 * MODES], int i) { return g[i] - g[2 * MODES + i]; }

/* The root of guard i between the fractions `low`, where it is positive, and `high`, by the Illinois method. */
static double root_between(const Motion *c, double h, int i, double low, double high) {
  const double shortest = DBL_EPSILON * high;
  double g[3 * MODES], a, b;
  int side = 0;
  guards_at(c, h, low, g), a = above(g, i);
  for (double part = high; a <= 0.0; a = above(g, i)) {
    part *= 0.5;
    if (low > 0.0 || part < shortest) return low;
    guards_at(c, h, part, g);
    if (above(g, i) > 0.0) low = part;
    else high = part;
  }
  guards_at(c, h, high, g), b = above(g, i);
  for (int k = 0; k < 60 && high - low > 1e-12 * high && b < 0.0; ++k) {
    const double part = within(low, (low * b - high * a) / (b - a), high);
    guards_at(c, h, part, g);
    const double x = above(g, i);
    if (x > 0.0) {
      low = part, a = x, b = side == 1 ? 0.5 * b : b, side = 1;
    } else {
      high = part, b = x, a = side == -1 ? 0.5 * a : a, side = -1;
    }
    if (x == 0.0) break;
  }
  return high;
}

/* The factor by which the length of a step may change so that it resolves a guard; see `jaxmodsim.EventSolver`. */
static double resolves(const double v[5], double lowest_value, double third, double error, double tolerance) {
  double high = v[0], low = v[0], headroom = lowest_value;
  for (int k = 1; k < 5; ++k) high = larger(high, v[k]), low = smaller(low, v[k]);
  for (int k = 1; k < 4; ++k) headroom = smaller(headroom, fabs(v[k]));
  const double cubic = smaller(0.3 * (high - low), 3.0 * headroom) + tolerance;
  const double quartic = smaller(0.05 * (high - low), 0.3 * headroom) + tolerance;
  const double by_third = third > 0.0 ? cbrt(cubic / third) : INFINITY;
  return smaller(by_third, error > 0.0 ? sqrt(sqrt(quartic / error)) : INFINITY);
}

/* The fraction of the last attempt at which the first guard falls through zero, 2 if none does. Also the factor by
   which its length may change, and the guard. */
static double look(Motion *c, double h, double *factor, int *first) {
  static const double parts[5] = {0.0, 1.0 / 3.0, 0.5, 2.0 / 3.0, 1.0};
  double earliest = 2.0;
  *factor = INFINITY;
  model_guards(c->s.t, c->s.numbers, c->s.y, c->s.mode, c->tolerances, c->guards[0]);
  for (int k = 1; k < 4; ++k) guards_at(c, h, parts[k], c->guards[k]);
  model_guards(c->s.t + h, c->s.numbers, c->end, c->s.mode, c->tolerances, c->guards[4]);
  for (int i = 0; i < MODES; ++i) {
    double v[5], size = 0.0, low = 0.0, bottom = INFINITY;
    for (int k = 0; k < 5; ++k) v[k] = c->guards[k][i], size = larger(size, fabs(v[k]));
    const double c1 = -5.5 * v[0] + 9.0 * v[1] - 4.5 * v[3] + v[4];
    const double c2 = 9.0 * v[0] - 22.5 * v[1] + 18.0 * v[3] - 4.5 * v[4];
    const double third = v[4] - 3.0 * v[3] + 3.0 * v[1] - v[0], c3 = 4.5 * third;
    const double error = 144.0 / 81.0 * fabs(v[2] - (v[0] + 0.5 * (c1 + 0.5 * (c2 + 0.5 * c3))));
    const double relative = larger(c->s.rtol, 1e3 * DBL_EPSILON);
    const double tolerance = relative * size + larger(c->guards[0][MODES + i], c->guards[4][MODES + i]);
    const double discriminant = c2 * c2 - 3.0 * c1 * c3;
    const double below = discriminant > 0.0 ? c2 + sqrt(discriminant) : 0.0;
    double lowest = 2.0;
    if (c1 < 0.0 && below > 0.0 && -c1 < below) {
      lowest = -c1 / below;
      bottom = v[0] + lowest * (c1 + lowest * (c2 + lowest * c3));
      if (bottom <= error) {
        double g[3 * MODES];
        guards_at(c, h, lowest, g), bottom = g[i];
      }
    }
    int high = !c->s.waits[i] || (c1 > 0.0 && v[0] >= -ZERO * c1);
    /* An input that jumps may leave a guard violated that rises again within the step. */
    const int violated = v[0] < -c->guards[0][MODES + i] || (v[0] <= 0.0 && v[1] < 0.0 && c1 <= 0.0);
    if (!c->s.waits[i] && violated) {
      earliest = 0.0, *first = i;
      continue;
    }
    for (int k = 1; k < 5; ++k) {
      double fall = high && v[k] < 0.0 ? parts[k] : 2.0;
      if (high && bottom < 0.0 && lowest > parts[k - 1] && lowest < parts[k]) fall = lowest;
      if (fall <= 1.0) {
        const double root = root_between(c, h, i, low, fall);
        if (root < earliest) earliest = root, *first = i;
        break;
      }
      if (v[k] > 0.0) high = 1, low = parts[k];
    }
    *factor = smaller(*factor, resolves(v, bottom > 0.0 ? bottom : INFINITY, fabs(third), error, tolerance));
  }
  return earliest;
}

/* Guards, and their rates along the motion. */
static const double *guards_and_rates(Motion *c, double g[3 * MODES]) {
  const State *s = &c->s;
  double rate[STATES];
  model_guards(s->t, s->numbers, s->y, s->mode, c->tolerances, g);
  model_rate(s->t, s->numbers, s->y, s->mode, rate);
  model_push(s->t, s->numbers, s->y, s->mode, c->tolerances, 1.0, c->numbers_seed, rate, c->pushed);
  return c->pushed + STATES;
}

static int mark(Motion *c, double near, int first) {
  State *s = &c->s;
  double g[3 * MODES];
  const double *rates = guards_and_rates(c, g);
  s->pending = 0;
  for (int i = 0; i < MODES; ++i) {
    const double left = above(g, i);
    /* The gap of a contact that opens has a velocity of rounding, of either sign, which does not close it again. */
    const int comes = rates[i] < -c->tolerances[0] && left >= 0.0 && left <= -rates[i] * near;
    /* In stick the load has a rate of rounding where an input drives it. */
    const double falls = i < SLIPS ? c->tolerances[0] : 0.0;
    const int beyond = g[i] < 0.0 && (rates[i] <= falls || g[i] < -g[MODES + i]);
    if (g[i] > 0.0) s->waits[i] = 0;
    s->fired[i] = i == first || (!s->waits[i] && (comes || beyond));
    s->pending |= s->fired[i] != 0.0;
  }
  return s->pending;
}

int motion_due(Motion *c, double near) { return mark(c, near, -1); }

int motion_violated(Motion *c) {
  const State *s = &c->s;
  double g[3 * MODES];
  model_guards(s->t, s->numbers, s->y, s->mode, c->tolerances, g);
  for (int i = 0; i < MODES; ++i) {
    if (!s->waits[i] && g[i] < -g[MODES + i]) return 1;
  }
  return 0;
}

void motion_move(Motion *c, double by) {
  State *s = &c->s;
  double rate[STATES], y[STATES];
  model_rate(s->t, s->numbers, s->y, s->mode, rate);
  for (int n = 0; n < STATES; ++n) y[n] = s->y[n] + 0.5 * by * rate[n];
  model_rate(s->t + 0.5 * by, s->numbers, y, s->mode, rate);
  for (int n = 0; n < STATES; ++n) s->y[n] += by * rate[n];
  s->t += by, c->linearised = 0;
}

double motion_to_root(Motion *c) {
  double g[3 * MODES], way = 0.0;
  const double *rates = guards_and_rates(c, g);
  int found = 0;
  for (int i = 0; i < MODES; ++i) {
    const double each = rates[i] != 0.0 ? -above(g, i) / rates[i] : 0.0;
    if (c->s.fired[i] != 0.0 && (!found || each < way)) way = each, found = 1;
  }
  return way;
}

/* Moves the state to the root of guard i, by at most `near`, to rounding. */
static void settle_on_root(Motion *c, int i, double near) {
  double g[3 * MODES], left = near;
  for (int k = 0; k < 3; ++k) {
    const double *rates = guards_and_rates(c, g);
    const double by = rates[i] < 0.0 ? -above(g, i) / rates[i] : 0.0;
    if (by == 0.0 || !(fabs(by) <= left)) return;
    motion_move(c, by);
    left -= fabs(by);
  }
}

int motion_fire(Motion *c) {
  State *s = &c->s;
  for (int k = 0; s->pending && k < TRIALS; ++k) {
    const double since = s->t - s->last;
    double y[STATES], mode[MODES];
    s->spread = s->resets == 0 ? since : larger(since, FORGET * s->spread);
    const double vanishes = larger(ACCUMULATION * sqrt(DBL_EPSILON) * (s->t - s->begin), 64.0 * DBL_EPSILON * fabs(s->t));
    int strikes = 0;
    for (int i = SLIPS; i < SLIPS + CONTACTS; ++i) strikes |= s->fired[i] != 0.0;
    s->alone = strikes ? 0 : s->alone + 1;
    const int accumulate = s->resets >= FEWEST && s->spread <= vanishes, dense = accumulate && strikes;
    if (accumulate && (s->alone > FEWEST || (s->resets > TRIALS && s->spread == 0.0))) {
      c->failure = "events accumulate: modes switch again and again without time between (chatter)";
      return 0;
    }
    memcpy(y, s->y, sizeof y), memcpy(mode, s->mode, sizeof mode);
    /* An importer does not resolve a rebound below its tolerance. */
    model_switch(s->t, s->numbers, c->tolerances, s->fired, dense, c->coarse ? s->atol : 0.0, s->y, s->mode);
    if (CONTACTS && (memcmp(mode, s->mode, sizeof mode) || memcmp(y, s->y, sizeof y))) motion_project(c, s->y);
    ++s->resets, s->last = s->t, c->linearised = 0;
    if (dense) {
      double g[3 * MODES];
      model_guards(s->t, s->numbers, s->y, s->mode, c->tolerances, g);
      for (int i = SLIPS; i < SLIPS + CONTACTS; ++i) s->waits[i] = g[i] <= 0.0;
    } else memset(s->waits, 0, sizeof s->waits);
    motion_due(c, 0.0);
  }
  if (s->pending) c->failure = "events accumulate: an event leads to another one without end";
  return !s->pending;
}

/* Ends the step on the root of guard `first` at the fraction `part` of the last attempt, of the length h. */
static void land(Motion *c, double h, double part, int first) {
  State *s = &c->s;
  const double shortest = resolution(s);
  double near = smaller(LANDING * h, LANDING_OF_INTERVAL * (s->t + part * h - s->last));
  near = larger(near, shortest);
  if (part * h > shortest) {
    const State before = *s;
    double by = 0.0, length = part * h;
    for (int k = 0; k < 6; ++k) {
      double g[3 * MODES];
      *s = before, c->linearised = 1; /* `linear` is still that of the start */
      attempt(c, length);
      memcpy(s->y, c->end, sizeof s->y), s->t += length, c->linearised = 0;
      const double *rates = guards_and_rates(c, g);
      by = rates[first] < 0.0 ? -above(g, first) / rates[first] : 0.0;
      if (!(fabs(by) > near) || !(length + by > shortest) || length + by > 1.5 * h) break;
      length += by;
    }
  }
  settle_on_root(c, first, 8.0 * near);
  mark(c, near, first);
}
#else
int motion_due(Motion *c, double near) { return (void)c, (void)near, 0; }
int motion_violated(Motion *c) { return (void)c, 0; }
double motion_to_root(Motion *c) { return (void)c, 0.0; }
void motion_move(Motion *c, double by) { (void)c, (void)by; }
int motion_fire(Motion *c) { return (void)c, 1; }
#endif

int motion_advance(Motion *c, double end) {
  State *s = &c->s;
  int doubts = 0;
  double most = INFINITY;
  if (s->step <= 0.0) first_step(c);
  for (int trial = 0; trial < TRIALS; ++trial) {
    const double left = end - s->t;
    if (left <= resolution(s)) {
      s->t = end;
      return REACHED;
    }
    const double length = smaller(s->step, most);
    const int last = length >= left * (1.0 - 1e-9);
    const double h = last ? left : length, error = attempt(c, h);
    const double next = h * within(0.2, 0.9 * pow(error, -0.2), 10.0);
    if (!(error <= 1.0)) {
      s->step = error < INFINITY ? next : 0.2 * h;
      if (s->step <= resolution(s)) {
        c->failure = "no step is short enough: the equations have no unique solution, or their rates are not finite";
        return FAILED;
      }
      continue;
    }
#if MODES
    double factor;
    int first = 0;
    const double part = look(c, h, &factor, &first);
    /* A step past a root is repeated up to it: its five points may miss a fall before, in stick above all. */
    if (part < ENDS && part * h > resolution(s) && doubts++ < DOUBTS) {
      most = (1.0 + 0.5 * (1.0 - ENDS)) * part * h;
      continue;
    }
    if (part <= 1.0 && (factor >= 0.9 || part * h <= resolution(s) || doubts >= DOUBTS)) {
      land(c, h, part, first);
      return EVENT;
    }
    if (factor < 0.9 && doubts++ < DOUBTS) {
      s->step = within(0.2, 0.9 * factor, 0.9) * h;
      continue;
    }
    for (int i = 0; i < MODES; ++i) {
      if (c->guards[4][i] > 0.0) s->waits[i] = 0;
    }
#else
    (void)doubts, (void)most;
#endif
    memcpy(s->y, c->end, sizeof s->y);
    s->t = last ? end : s->t + h;
    s->step = last ? larger(s->step, next) : next;
    if (last) s->step = smaller(s->step, 10.0 * h);
    c->linearised = 0;
    return REACHED;
  }
  c->failure = "no step was accepted";
  return FAILED;
}
