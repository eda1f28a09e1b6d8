/* The motion of a scene: its state, and the functions that advance it. */
#ifndef JAXMODSIM_MOTION_H
#define JAXMODSIM_MOTION_H
#include <stdint.h>
#include "model.h"

#define SPACE(n) ((n) > 0 ? (n) : 1)

/* All that determines the further motion; fmi3GetFMUState copies it. */
typedef struct {
  double t, numbers[SPACE(NUMBERS)], y[STATES], mode[SPACE(MODES)];
  double rtol, atol;
  double step;                /* length of the next step, 0 if unknown */
  double ended, before; /* ends of the last two steps of an importer */
  double begin, last, spread; /* start, last event, the longest of the last intervals between events */
  double back;                /* time from the instant of an importer to the root of the event there */
  double fired[SPACE(MODES)]; /* guards whose event is pending */
  int32_t waits[SPACE(MODES)]; /* guards that must be positive before they fire */
  int32_t resets, alone; /* events, and those since the last one of a contact */
  int32_t pending, changed, moved, phase;
} State;

typedef struct {
  State s;
  double tolerances[3]; /* speed of rest, relative and absolute tolerance */
  int linearised;
  int coarse; /* whether an importer integrates: what it does not resolve are events without time between */
  double linear[STATES * (STATES + 2)]; /* rates, their time derivative, and their Jacobian */
  double factors[STATES][STATES], stage[8][STATES], end[STATES], raw[STATES], dense[3][STATES];
  int rows[STATES];
  double guards[5][3 * SPACE(MODES)], pushed[EVALUATED];
  double numbers_seed[SPACE(NUMBERS)]; /* zeros between calls */
  const char *failure;
} Motion;

enum { REACHED, EVENT, FAILED };

/* The state as exported. */
void motion_reset(Motion *c);
/* Tolerances of s into those of the equations. */
void motion_tolerances(Motion *c);
/* Whether the numbers are in their ranges; if not, `failure` says which is needed. */
int motion_admits(Motion *c);
/* Modes for the state and numbers, as at the start of a run; false if a number is out of its range. */
int motion_start(Motion *c);
/* The state on the constraints, and without slip in stick; its distance from there, in tolerances. */
double motion_project(Motion *c, double y[STATES]);
/* Marks the guards whose event is now, or within the time `near`; whether there is one. */
int motion_due(Motion *c, double near);
/* Whether a guard is below zero by more than its tolerance. */
int motion_violated(Motion *c);
/* Time from now to the root of the first of the guards that are marked. */
double motion_to_root(Motion *c);
/* Moves the state by a short time. */
void motion_move(Motion *c, double by);
/* The event of the guards that are marked, and those that follow from it; false if events accumulate. */
int motion_fire(Motion *c);
/* Advances towards `end` by one step, and at most to the next event, which is marked. */
int motion_advance(Motion *c, double end);
#endif
