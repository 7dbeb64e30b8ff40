/* A model-predictive controller of a thermal plant: one move for every reading.
 *
 *     static tg_controller controller;
 *     tg_reset(&controller, &tg_the_design, y, d);
 *     every dt seconds:  move = tg_step(&controller, time_s, y, d, NULL, target);
 *
 * With the time of each reading it may be called at any rate: estimate, plan and slew count the seconds that
 * passed, and before its sample time is over the last move is held, but for a new target.
 *
 * y, d and target hold temperatures [degC]; NAN where a reading is lost.  No malloc, no file, no clock; one
 * struct a controller.  Whatever the status, a drive is finite, inside its range and within its slew limit.
 *
 * There is no clock, so a deadline is a question to the program around: where controller.late is set (after
 * tg_reset), it is asked before the optimiser starts, before every change of its working set, and at the end.
 * Once it answers other than 0, the last plan goes on, then the PI controller, and the status is TG_LATE.
 */
#ifndef TG_CONTROLLER_H
#define TG_CONTROLLER_H

#include "tg_config.h"
#include "tg_qp.h"

#define TG_Z (TG_NX + TG_NW)               /* states of the observer */
#define TG_SEEDS (TG_NX + TG_NU + TG_ND)   /* directions of a sample's Jacobian */
#define TG_WIDE ((((TG_SEEDS > TG_Q_N ? TG_SEEDS : TG_Q_N) + 3) / 4) * 4)
#define TG_ROOM (TG_Z * TG_Z > 2 * TG_NX * TG_WIDE ? TG_Z * TG_Z : 2 * TG_NX * TG_WIDE)
#define TG_SOME(n) ((n) > 0 ? (n) : 1)

enum tg_status { TG_OK = 0, TG_LATE, TG_INFEASIBLE, TG_FALLBACK_PLAN, TG_FALLBACK_PI, TG_OFF };

enum tg_advice {
    TG_ALL_WELL = 0,
    TG_TOO_EARLY,
    TG_STALE,
    TG_RESTARTED,
    TG_LOST_READING,
    TG_NO_TARGET,
    TG_BAD_TARGET,
    TG_BLIND,
    TG_SOLVER,
    TG_OUT_OF_RANGE,
    TG_LIMIT_BREAKS,
    TG_STUCK,
    TG_TOO_LATE,
    TG_SENSOR_OFFSET,
    TG_WORLD_CHANGED,
    TG_UNSEEN,
    TG_PUMP_OFF
};

typedef struct {
    double drive[TG_NU];
    int pump;       /* 1 running, 0 off */
    int status;     /* enum tg_status */
    int advice;     /* enum tg_advice; tg_advice_text has its sentence */
    int which;      /* where one output is advised of: which */
    int iterations; /* of the quadratic program */
    double over;    /* by how much a limit will be broken [degC]; how long nobody called [s]: where advised */
} tg_move;

typedef double tg_time; /* seconds of any clock */

typedef struct {
    const tg_design *design;
    const double *goals;      /* targets of each of the N samples ahead, n_c each; NULL: they stay */
    int (*late)(void *about); /* whether time is up; NULL: never */
    void *about;
    /* observer */
    double x[TG_NX], w[TG_SOME(TG_NW)];
    double P[TG_Z * TG_Z], found_offset[TG_NY];
    int held[TG_Z];
    double into_s, share, noised;      /* seconds since x; of a sample: time of the estimate, and the noise in P */
    double dose[TG_NU], ahead[TG_NX];  /* the drives summed over those seconds, the state there */
    double bent[TG_NY];                /* how far an output may be from the straight line between two samples */
    /* when it was called */
    tg_time time_s, back_s;
    double interval_s, passed_s, since_s, assumed_s, spent_s, waited_s, slew_s;
    double stood_s, before_s; /* since a move to other targets; of the sample, at a move between two samples */
    double unspent_s;         /* of its slew limit, that the last move left */
    int repeats, stale, due, moves; /* whether a sample time is over, and whether this call moves the drives */
    /* loop */
    double d[TG_SOME(TG_ND)], y[TG_NY], u[TG_NU], target[TG_NC], side[TG_NC];
    double plan[TG_NH * TG_NU], unread_s[TG_NC], age_s, silent_s;
    double last_y[TG_NY], moved[TG_NY]; /* the newest reading, and what was expected since it changed */
    double seen[TG_NX];                 /* the state after the newest reading */
    double integral[TG_NC];             /* of the PI controller */
    double ramped[TG_NC];               /* where targets are that may only ramp */
    int has_plan, fresh, solves, on_pi, status, advice, spikes[TG_NY], stays[TG_NY];
    int ramps; /* whether targets are on their way in path */
    int lost[TG_NC]; /* outputs that cost nothing */
    /* what the last optimisation gave */
    double best[TG_Q_N], y_best[TG_NH * TG_NY], authority[TG_Q_N], broken;
    int qp_status, iterations, breaks; /* and which output will break its limit by so much */
    int kept_lost[TG_NC], has_gains, laid_out, has_jacobian; /* of a linear plant: for what H was made, and whether there is a G */
    /* room to work in */
    tg_qp qp;
    double path[TG_SOME(TG_NR)]; /* in place of goals, where targets may only ramp */
    double G[TG_SOME(TG_NE)]; /* the response: the soft rows of the program, sample by sample */
    double y_guess[TG_NH * TG_NY], y_try[TG_NH * TG_NY];
    double free[TG_NH * TG_SOME(TG_NS)];
    double seed[TG_ROOM], seed_u[TG_NU * TG_WIDE], seed_d[TG_SOME(TG_ND) * TG_WIDE];
    double by_drives[4 * TG_SOME(TG_NF)]; /* what the drives of four blocks fix in the model's step */
    double partials[TG_SOME(TG_NM)], jacobian[TG_Z * TG_Z];
} tg_controller;

#ifdef __cplusplus
extern "C" {
#endif

/* Forget the past; the plant is at rest at this reading, its drives at zero. */
void tg_reset(tg_controller *c, const tg_design *design, const double *y, const double *d);

/* Return the move for this sample.
 * time_s: of the reading, or NAN; then one sample time has passed.  applied: what the drives really did since
 * the last step, or NULL.  Called more often than its sample time it holds its move until the call that is
 * nearest to it, or until a target that has stood for a sample is another one; called more seldom it moves each
 * time. */
tg_move tg_step(tg_controller *c, tg_time time_s, const double *y, const double *d, const double *applied,
                const double *target);

/* The same where the pump is off: no water moves the heat, so the drives go back to none, and the estimate starts
 * again when the pump runs. */
tg_move tg_pause(tg_controller *c, tg_time time_s, const double *y, const double *d, const double *target);

const char *tg_status_text(int status);
const char *tg_advice_text(int advice);

/* The parts, for tests and for other loops. */
void tg_observer_reset(tg_controller *c, const double *y, const double *d);
void tg_observer_update(tg_controller *c, const double *y);
/* Take what a reading differs by for offsets of the sensors that are not 0 in which. */
void tg_observer_set_offsets(tg_controller *c, const double *y, const int *which);
void tg_observer_predict(tg_controller *c, const double *u, const double *d);
void tg_observer_advance(tg_controller *c, double seconds, const double *u, const double *d);
void tg_observer_look(tg_controller *c, const double *d);
const double *tg_now(const tg_controller *c); /* the state at the time of the estimate */
void tg_biases(const tg_controller *c, double *on_u, double *on_d, double *on_y);
void tg_expected(const tg_controller *c, double *y);
void tg_hold_drives(tg_controller *c);
double tg_planned(const tg_controller *c, int k, int j); /* drive j in the k-th sample from now */
void tg_guess(const tg_controller *c, const double *last, double *guess);
void tg_keep_plan(tg_controller *c);
/* Outputs of a plan, sample by sample, plus the output bias. */
void tg_simulate(tg_controller *c, const double *start, const double *plan, const double *drive_bias, const double *d,
                 const double *bias, double *y);
/* Improve a plan; y_best has the outputs that count, of a plant that is not linear all. */
int tg_optimise(tg_controller *c, const double *x, const double *last, const double *guess, const double *d,
                const double *target, const double *side, const double *bias, const double *drive_bias);

#ifdef __cplusplus
}
#endif

#endif
