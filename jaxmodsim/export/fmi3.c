/* A scene as an instance of FMI 3.0, for model exchange and co-simulation. Memory is allocated for instances and for
   saved states alone. */
#include "fmi3.h"
#include "motion.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { INSTANTIATED, INITIALIZATION, EVENT_MODE, CONTINUOUS_TIME, STEP_MODE, TERMINATED };

/* Value references, in this order: time, numbers, states, their rates, guards, outputs, modes. */
enum {
  FIRST_NUMBER = 1,
  FIRST_STATE = FIRST_NUMBER + NUMBERS,
  FIRST_EVALUATED = FIRST_STATE + STATES,
  FIRST_MODE = FIRST_EVALUATED + EVALUATED,
  END = FIRST_MODE + THINGS
};

typedef struct {
  Motion motion;
  bool steps, logs, eventMode, earlyReturn;
  double seed[1 + SPACE(NUMBERS) + STATES], evaluated[EVALUATED];
  fmi3InstanceEnvironment environment;
  fmi3LogMessageCallback log;
  fmi3IntermediateUpdateCallback update;
} Instance;

#define SELF Instance *c = instance
#define STATE State *s = &((Instance *)instance)->motion.s
#define PRESENT \
  State s;      \
  if (!present(c, &s)) return fmi3Error

static fmi3Status fail(Instance *c, const char *message) {
  if (c->log) c->log(c->environment, fmi3Error, "error", message);
  return fmi3Error;
}

static fmi3Status no_variable(Instance *c, const char *what, fmi3ValueReference reference) {
  char text[120];
  snprintf(text, sizeof text, "%s: the value reference %u has no such variable", what, (unsigned)reference);
  return fail(c, text);
}

const char *fmi3GetVersion(void) { return "3.0"; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[]) {
  SELF;
  (void)n, (void)categories;
  c->logs = on;
  return fmi3OK;
}

/* ---- instances ---- */

static fmi3Instance instantiate(fmi3String token, bool steps, bool logs, fmi3InstanceEnvironment environment,
                                fmi3LogMessageCallback log) {
  Instance *c = token && !strcmp(token, TOKEN) ? calloc(1, sizeof(Instance)) : NULL;
  if (!c) {
    if (log) log(environment, fmi3Error, "error", "instantiation: the token is not that of this FMU, or memory is short");
    return NULL;
  }
  c->steps = steps, c->logs = logs, c->environment = environment, c->log = log;
  motion_reset(&c->motion);
  c->motion.coarse = !steps;
  return c;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logs, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log) {
  (void)name, (void)resources, (void)visible;
  return instantiate(token, false, logs, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logs, fmi3Boolean eventMode, fmi3Boolean earlyReturn,
                                         const fmi3ValueReference intermediate[], size_t nIntermediate,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
  Instance *c = instantiate(token, true, logs, environment, log);
  (void)name, (void)resources, (void)visible, (void)intermediate, (void)nIntermediate;
  if (c) c->eventMode = eventMode, c->earlyReturn = earlyReturn, c->update = update;
  return c;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logs,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
  (void)name, (void)token, (void)resources, (void)visible, (void)logs, (void)update, (void)lock, (void)unlock;
  if (log) log(environment, fmi3Error, "error", "scheduled execution is not a mode of this FMU");
  return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3Reset(fmi3Instance instance) {
  SELF;
  motion_reset(&c->motion);
  c->motion.coarse = !c->steps;
  return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
  STATE;
  s->phase = TERMINATED;
  return fmi3OK;
}

/* ---- phases ---- */

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stopDefined, fmi3Float64 stop) {
  SELF;
  STATE;
  (void)stopDefined, (void)stop;
  if (s->phase != INSTANTIATED) return fail(c, "the initialization mode follows instantiation or reset");
  if (toleranceDefined && tolerance > 0.0) s->atol *= tolerance / s->rtol, s->rtol = tolerance;
  s->t = s->begin = s->last = s->ended = s->before = start;
  s->phase = INITIALIZATION;
  motion_tolerances(&c->motion);
  return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
  SELF;
  STATE;
  if (s->phase != INITIALIZATION) return fail(c, "no initialization mode to exit");
  if (!motion_start(&c->motion)) return fail(c, c->motion.failure);
  s->phase = c->steps && !c->eventMode ? STEP_MODE : EVENT_MODE;
  return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
  SELF;
  STATE;
  if (s->phase != CONTINUOUS_TIME && s->phase != STEP_MODE) return fail(c, "the event mode follows a step");
  if (!c->steps) s->moved = motion_project(&c->motion, s->y) > 0.0;
  if (!c->steps && motion_due(&c->motion, 64.0 * 2.3e-16 * fabs(s->t))) {
    /* Importers stop behind the root; the event is at the root, but not before the last one. */
    const double step = s->ended < s->t ? s->ended : s->before, back = motion_to_root(&c->motion);
    /* A root out of the last step is none of the motion: an input drives the guard, whose own rate is rounding. */
    s->back = back > 64.0 * 2.3e-16 * fabs(s->t) || (s->last < step && s->t + back < step) ? 0.0 : back;
    if (s->t + s->back < s->last) s->back = s->last - s->t;
  }
  s->phase = EVENT_MODE;
  return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
  STATE;
  s->phase = CONTINUOUS_TIME;
  return fmi3OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance) {
  STATE;
  s->phase = STEP_MODE;
  return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance) { return (void)instance, fmi3OK; }
fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance) { return fail(instance, "no structural parameters"); }
fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance) { return fail(instance, "no structural parameters"); }

/* The event that is pending, then those that changed inputs cause. */
static bool events(Motion *m) {
  State *s = &m->s;
  if (s->pending) {
    const double back = s->back;
    s->back = 0.0;
    if (back != 0.0) motion_move(m, back);
    if (!motion_fire(m)) return false;
    if (back != 0.0) motion_move(m, -back);
  }
  if (s->changed && !motion_start(m)) return false;
  return !motion_due(m, 0.0) || motion_fire(m);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominalsChanged, fmi3Boolean *statesChanged,
                                    fmi3Boolean *nextTimeDefined, fmi3Float64 *nextTime) {
  SELF;
  STATE;
  double y[STATES];
  if (s->phase != EVENT_MODE) return fail(c, "discrete states are updated in the event mode");
  *again = *terminate = *nominalsChanged = *nextTimeDefined = false, *nextTime = 0.0;
  memcpy(y, s->y, sizeof y);
  if (!events(&c->motion)) return fail(c, c->motion.failure);
  *statesChanged = s->moved || memcmp(y, s->y, sizeof y) != 0;
  s->moved = 0;
  return fmi3OK;
}

/* ---- variables ---- */

static bool settable(const Instance *c, fmi3ValueReference r) {
  const int phase = c->motion.s.phase;
  if (phase == TERMINATED) return false;
  if (r >= FIRST_STATE) return phase <= INITIALIZATION;
  /* The next event decides modes for discrete inputs that an importer changes in continuous time. */
  return phase != CONTINUOUS_TIME || model_kinds[r - FIRST_NUMBER] != PARAMETER;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, REFERENCES, const fmi3Float64 values[], size_t nValues) {
  SELF;
  STATE;
  if (nValues != nReferences) return fail(c, "set: one value for each variable is needed");
  for (size_t i = 0; i < nValues; ++i) {
    const fmi3ValueReference r = references[i];
    if (r < FIRST_NUMBER || r >= FIRST_EVALUATED) return no_variable(c, "set Float64", r);
    double *at = r >= FIRST_STATE ? &s->y[r - FIRST_STATE] : &s->numbers[r - FIRST_NUMBER];
    if (*at == values[i]) continue; /* importers repeat values outside of events */
    if (!settable(c, r)) return no_variable(c, "set at this time", r);
    if (!isfinite(values[i])) return fail(c, "set: the value is not finite");
    if (r < FIRST_STATE && model_kinds[r - FIRST_NUMBER] != CONTINUOUS_INPUT) {
      s->changed = s->phase > INITIALIZATION;
    }
    *at = values[i], c->motion.linearised = 0;
  }
  return fmi3OK;
}

/* Numbers that changed between events are checked when they are used. */
static bool usable(Instance *c) {
  if (!c->motion.s.changed || motion_admits(&c->motion)) return true;
  return fail(c, c->motion.failure), false;
}

/* The state with which the motion goes on: modes are decided when the initialization or a change between steps ends. */
static bool present(Instance *c, State *s) {
  Motion m = c->motion;
  *s = m.s;
  if (s->phase == INITIALIZATION || (s->phase == STEP_MODE && s->changed)) {
    if (!motion_start(&m)) return fail(c, m.failure), false;
  } else if (!usable(c)) {
    return false;
  } else if (s->phase == STEP_MODE && !s->pending && motion_due(&m, 0.0) && !motion_fire(&m)) {
    return true;
  }
  *s = m.s;
  return true;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, REFERENCES, fmi3Float64 values[], size_t nValues) {
  SELF;
  State s = c->motion.s;
  bool begun = false, known = false;
  if (nValues != nReferences) return fail(c, "get: one value for each variable is needed");
  for (size_t i = 0; i < nValues; ++i) {
    const fmi3ValueReference r = references[i];
    if (r >= FIRST_MODE) return no_variable(c, "get Float64", r);
    if (r >= FIRST_STATE && !begun && !(begun = present(c, &s))) return fmi3Error;
    if (r >= FIRST_EVALUATED && !known) {
      model_evaluate(s.t, s.numbers, s.y, s.mode, c->motion.tolerances, c->evaluated), known = true;
    }
    values[i] = r == 0             ? s.t
                : r < FIRST_STATE  ? s.numbers[r - FIRST_NUMBER]
                : r < FIRST_EVALUATED ? s.y[r - FIRST_STATE]
                                      : c->evaluated[r - FIRST_EVALUATED];
  }
  return fmi3OK;
}

fmi3Status fmi3GetInt32(fmi3Instance instance, REFERENCES, fmi3Int32 values[], size_t nValues) {
  SELF;
  PRESENT;
  if (nValues != nReferences) return fail(c, "get: one value for each variable is needed");
  for (size_t i = 0; i < nValues; ++i) {
    const fmi3ValueReference r = references[i];
    if (r < FIRST_MODE || r >= END) return no_variable(c, "get Int32", r);
    const int start = model_modes[r - FIRST_MODE], stop = model_modes[r - FIRST_MODE + 1];
    values[i] = (fmi3Int32)s.mode[start];
    for (int k = start; k < stop && stop > start + 1; ++k) values[i] = k == start ? s.mode[k] != 0.0
                                                                                  : values[i] || s.mode[k] != 0.0;
  }
  return fmi3OK;
}

#define NONE(NAME, ...)                                                        \
  fmi3Status NAME(fmi3Instance instance, REFERENCES, __VA_ARGS__) {            \
    (void)references, (void)nReferences;                                       \
    return nReferences ? fail(instance, #NAME ": no such variables") : fmi3OK; \
  }
#define NEITHER(TYPE)                                                                     \
  NONE(fmi3Get##TYPE, fmi3##TYPE values[], size_t n)                                      \
  NONE(fmi3Set##TYPE, const fmi3##TYPE values[], size_t n)
#if defined __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
NEITHER(Float32)
NEITHER(Int8)
NEITHER(UInt8)
NEITHER(Int16)
NEITHER(UInt16)
NONE(fmi3SetInt32, const fmi3Int32 values[], size_t n)
NEITHER(UInt32)
NEITHER(Int64)
NEITHER(UInt64)
NEITHER(Boolean)
NEITHER(String)
NONE(fmi3GetBinary, size_t sizes[], fmi3Binary values[], size_t n)
NONE(fmi3SetBinary, const size_t sizes[], const fmi3Binary values[], size_t n)
NONE(fmi3GetClock, fmi3Clock values[])
NONE(fmi3SetClock, const fmi3Clock values[])
NONE(fmi3GetIntervalDecimal, fmi3Float64 intervals[], fmi3IntervalQualifier kinds[])
NONE(fmi3GetIntervalFraction, fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier kinds[])
NONE(fmi3GetShiftDecimal, fmi3Float64 shifts[])
NONE(fmi3GetShiftFraction, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
NONE(fmi3SetIntervalDecimal, const fmi3Float64 intervals[])
NONE(fmi3SetIntervalFraction, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
NONE(fmi3SetShiftDecimal, const fmi3Float64 shifts[])
NONE(fmi3SetShiftFraction, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
NONE(fmi3GetOutputDerivatives, const fmi3Int32 orders[], fmi3Float64 values[], size_t n)

fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clock, fmi3Float64 time) {
  return fail(instance, "scheduled execution is not a mode of this FMU");
}
fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance, fmi3ValueReference reference, size_t *n) {
  return fail(instance, "dependencies of single elements are not provided");
}
fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference reference, size_t indices[],
                                       fmi3ValueReference independents[], size_t elements[], fmi3DependencyKind kinds[],
                                       size_t n) {
  return fail(instance, "dependencies of single elements are not provided");
}

/* ---- saved states ---- */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *saved) {
  SELF;
  if (!*saved) *saved = malloc(sizeof(State));
  if (!*saved) return fail(c, "memory for a saved state is short");
  memcpy(*saved, &c->motion.s, sizeof(State));
  return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState saved) {
  SELF;
  memcpy(&c->motion.s, saved, sizeof(State));
  motion_tolerances(&c->motion);
  c->motion.linearised = 0;
  return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *saved) {
  if (saved) free(*saved), *saved = NULL;
  return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState saved, size_t *size) {
  *size = sizeof(State) + sizeof TOKEN;
  return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState saved, fmi3Byte bytes[], size_t size) {
  if (size < sizeof(State) + sizeof TOKEN) return fail(instance, "the space for the serialized state is too small");
  memcpy(bytes, TOKEN, sizeof TOKEN);
  memcpy(bytes + sizeof TOKEN, saved, sizeof(State));
  return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *saved) {
  if (size < sizeof(State) + sizeof TOKEN || memcmp(bytes, TOKEN, sizeof TOKEN)) {
    return fail(instance, "the serialized state is not one of this FMU");
  }
  if (!*saved) *saved = malloc(sizeof(State));
  if (!*saved) return fail(instance, "memory for a saved state is short");
  memcpy(*saved, bytes + sizeof TOKEN, sizeof(State));
  return fmi3OK;
}

/* ---- derivatives ---- */

/* Whether all references are knowns (time, numbers, states), or unknowns (states, rates, guards, outputs). */
static bool inside(const fmi3ValueReference references[], size_t n, fmi3ValueReference first, fmi3ValueReference end) {
  for (size_t i = 0; i < n; ++i) {
    if (references[i] < first || references[i] >= end) return false;
  }
  return true;
}

#define CHECK_DERIVATIVE(SEEDS, RESULTS)                                                                         \
  if (nSeed != (SEEDS) || nSensitivity != (RESULTS)) return fail(c, "derivative: one number for each variable"); \
  if (!inside(knowns, nKnowns, 0, FIRST_EVALUATED) || !inside(unknowns, nUnknowns, FIRST_STATE, FIRST_MODE)) {   \
    return fail(c, "derivative: knowns are time, numbers and states; unknowns are states, rates, indicators and " \
                   "outputs");                                                                                   \
  }                                                                                                              \
  memset(c->seed, 0, sizeof c->seed), memset(c->evaluated, 0, sizeof c->evaluated)

fmi3Status fmi3GetDirectionalDerivative(DERIVATIVE) {
  SELF;
  PRESENT;
  CHECK_DERIVATIVE(nKnowns, nUnknowns);
  for (size_t i = 0; i < nKnowns; ++i) c->seed[knowns[i]] += seed[i];
  model_push(s.t, s.numbers, s.y, s.mode, c->motion.tolerances, c->seed[0], c->seed + FIRST_NUMBER,
             c->seed + FIRST_STATE, c->evaluated);
  for (size_t i = 0; i < nUnknowns; ++i) {
    const fmi3ValueReference r = unknowns[i];
    sensitivity[i] = r < FIRST_EVALUATED ? c->seed[r] : c->evaluated[r - FIRST_EVALUATED];
  }
  return fmi3OK;
}

fmi3Status fmi3GetAdjointDerivative(DERIVATIVE) {
  SELF;
  PRESENT;
  double direct[STATES] = {0.0};
  CHECK_DERIVATIVE(nUnknowns, nKnowns);
  for (size_t i = 0; i < nUnknowns; ++i) {
    const fmi3ValueReference r = unknowns[i];
    *(r < FIRST_EVALUATED ? &direct[r - FIRST_STATE] : &c->evaluated[r - FIRST_EVALUATED]) += seed[i];
  }
  model_pull(s.t, s.numbers, s.y, s.mode, c->motion.tolerances, c->evaluated, c->seed);
  for (int i = 0; i < STATES; ++i) c->seed[FIRST_STATE + i] += direct[i];
  for (size_t i = 0; i < nKnowns; ++i) sensitivity[i] = c->seed[knowns[i]];
  return fmi3OK;
}

/* ---- model exchange ---- */

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
  SELF;
  c->motion.s.t = time, c->motion.linearised = 0;
  return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 states[], size_t n) {
  SELF;
  if (n != STATES) return fail(c, "the number of continuous states is another one");
  memcpy(c->motion.s.y, states, sizeof c->motion.s.y), c->motion.linearised = 0;
  return fmi3OK;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 states[], size_t n) {
  SELF;
  if (n != STATES) return fail(c, "the number of continuous states is another one");
  memcpy(states, c->motion.s.y, sizeof c->motion.s.y);
  return fmi3OK;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[], size_t n) {
  SELF;
  STATE;
  if (n != STATES) return fail(c, "the number of continuous states is another one");
  if (!usable(c)) return fmi3Error;
  model_rate(s->t, s->numbers, s->y, s->mode, derivatives);
  for (int i = 0; i < STATES; ++i) {
    if (!isfinite(derivatives[i])) return fmi3Discard; /* the importer may try a shorter step */
  }
  return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t n) {
  SELF;
  if (n != MODES) return fail(c, "the number of event indicators is another one");
#if MODES
  STATE;
  if (!usable(c)) return fmi3Error;
  model_guards(s->t, s->numbers, s->y, s->mode, c->motion.tolerances, c->motion.guards[0]);
  memcpy(indicators, c->motion.guards[0], MODES * sizeof(double));
  /* A gap that has just opened is smaller than the errors of an importer, whose sign is no event. */
  for (int i = SLIPS; i < SLIPS + CONTACTS; ++i) indicators[i] += c->motion.guards[0][MODES + i];
#endif
  return fmi3OK;
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t n) {
  STATE;
  for (size_t i = 0; i < n; ++i) nominals[i] = s->atol / s->rtol;
  return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *n) { return *n = MODES, fmi3OK; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *n) { return *n = STATES, fmi3OK; }

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean noSetStateBefore,
                                       fmi3Boolean *enterEventMode, fmi3Boolean *terminate) {
  SELF;
  double y[STATES];
  State *s = &c->motion.s;
  memcpy(y, s->y, sizeof y);
  if (s->ended < s->t) s->before = s->ended, s->ended = s->t;
  *terminate = false;
  /* An event moves the state back onto constraints, and to zero slip in stick; an importer may have missed another. */
  *enterEventMode = motion_project(&c->motion, y) > 0.5 || motion_violated(&c->motion);
  return fmi3OK;
}

/* ---- co-simulation ---- */

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 length, fmi3Boolean noSetStateBefore,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
  SELF;
  STATE;
  Motion *m = &c->motion;
  const double end = time + length;
  const bool returns = c->eventMode && c->earlyReturn;
  *event = *terminate = *early = false, *reached = s->t;
  if (s->phase != STEP_MODE) return fail(c, "steps are made in the step mode");
  if (!(length > 0.0) || fabs(time - s->t) > 1e-9 * (fabs(time) + length)) {
    return fail(c, "a step begins where the last one ended, and has a positive length");
  }
  if (s->changed && !motion_start(m)) return fail(c, m->failure);
  while (s->t < end) {
    const int outcome = motion_advance(m, end);
    fmi3Boolean stop = false;
    fmi3Float64 there = end;
    if (outcome == FAILED) return fail(c, m->failure);
    *reached = s->t;
    if (outcome == EVENT && returns) {
      *event = true, *early = s->t < end;
      return fmi3OK;
    }
    if (outcome == EVENT && !motion_fire(m)) return fail(c, m->failure);
    if (c->update) c->update(c->environment, s->t, false, true, true, c->earlyReturn, &stop, &there);
    if (stop && c->earlyReturn && s->t < end) {
      *early = true;
      return fmi3OK;
    }
  }
  return fmi3OK;
}
