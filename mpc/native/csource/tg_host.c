/* What a program that loads this code as a library calls: a step by plain arrays, and a whole closed loop against
 * another plant. Not part of an export. */
#define _POSIX_C_SOURCE 199309L /* for the clock */
#include "tg_controller.h"
#include "tg_model.h"
#include "tg_relays.h"

#include <math.h>
#include <string.h>
#include <time.h>

long tg_host_size(void) { return (long)sizeof(tg_controller); }
long tg_host_design_size(void) { return (long)sizeof(tg_design); }

void tg_host_begin(tg_controller *c, const tg_design *design)
{
    memset(c, 0, sizeof *c);
    c->design = design;
}

double *tg_host_x(tg_controller *c) { return c->x; }
double *tg_host_w(tg_controller *c) { return c->w; }
double *tg_host_P(tg_controller *c) { return c->P; }
double *tg_host_found_offset(tg_controller *c) { return c->found_offset; }
double *tg_host_seen(tg_controller *c) { return c->seen; }
double *tg_host_target(tg_controller *c) { return c->target; }
double *tg_host_y(tg_controller *c) { return c->y; }
double *tg_host_unread_s(tg_controller *c) { return c->unread_s; }
int *tg_host_stays(tg_controller *c) { return c->stays; }
int *tg_host_qp_status(tg_controller *c) { return &c->qp_status; }

/* What is asked of each sample ahead. */
void tg_host_goals(tg_controller *c, const double *goals) { c->goals = goals; }

/* Who is asked whether time is up. */
void tg_host_late(tg_controller *c, int (*late)(void *about), void *about)
{
    c->late = late;
    c->about = about;
}

static double now_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* about: when a step must be over [s of the clock] */
int tg_host_clock(void *about) { return now_s() >= *(const double *)about; }

/* given: y, d, drives that were applied, NAN where they are none. */
void tg_host_reset(tg_controller *c, const double *given)
{
    int (*late)(void *about) = c->late;
    void *about = c->about;
    const double *applied = given + TG_NY + TG_ND;
    tg_reset(c, c->design, given, given + TG_NY);
    tg_host_late(c, late, about);
    for (int j = 0; j < TG_NU; j++)
        if (isfinite(applied[j]))
            c->u[j] = applied[j];
}

/* given: y, d, applied as at a reset, then time and targets; answer: drives, over, pump, status, advice, which,
 * iterations, and whether the drives were moved. */
void tg_host_step(tg_controller *c, const double *given, int paused, double seconds, double *answer)
{
    const double *applied = given + TG_NY + TG_ND, *target = applied + TG_NU + 1;
    tg_move move;
    if (c->late == tg_host_clock)
        *(double *)c->about = now_s() + seconds;
    move = paused ? tg_pause(c, applied[TG_NU], given, given + TG_NY, target)
                  : tg_step(c, applied[TG_NU], given, given + TG_NY, applied, target);
    memcpy(answer, move.drive, sizeof move.drive);
    answer += TG_NU;
    answer[0] = move.over;
    answer[1] = move.pump;
    answer[2] = move.status;
    answer[3] = move.advice;
    answer[4] = move.which;
    answer[5] = move.iterations;
    answer[6] = paused || c->moves;
}

/* The plan from now on, N rows of drives; whether there is one. */
int tg_host_plan(const tg_controller *c, double *plan)
{
    for (int k = 0; k < c->design->N; k++)
        for (int j = 0; j < TG_NU; j++)
            plan[k * TG_NU + j] = tg_planned(c, k, j);
    return c->has_plan;
}

/* One QP of n unknowns and s soft rows (A: s rows of n), for tests. */
int tg_host_qp(tg_controller *c, int n, int s, const double *H, const double *f, const double *lower,
               const double *upper, const double *A, double linear, double quadratic, int warm, double *x,
               int *iterations)
{
    tg_qp *q = &c->qp;
    int status;
    q->n = n;
    q->kept = 0;
    q->stride = TG_NU;
    q->s = s;
    q->per = 1;
    q->price[0] = q->at_end[0] = linear;
    q->ratio[0] = quadratic / linear;
    q->iteration_limit = 500;
    q->A = c->G;
    c->has_gains = c->laid_out = 0;
    memset(q->H, 0, sizeof q->H);
    for (int i = 0; i < n; i++)
        memcpy(q->H + (size_t)i * TG_Q_W, H + (size_t)i * (size_t)n, (size_t)(i + 1) * sizeof(double));
    memcpy(q->f, f, (size_t)n * sizeof(double));
    memcpy(q->lower, lower, (size_t)(2 * n + s) * sizeof(double));
    memcpy(q->upper, upper, (size_t)(2 * n + s) * sizeof(double));
    for (int i = 0; i < s; i++) {
        q->filled[i] = TG_WHOLE(n);
        q->start[i] = i * TG_WHOLE(n);
        memset(c->G + q->start[i], 0, (size_t)q->filled[i] * sizeof(double));
        memcpy(c->G + q->start[i], A + (size_t)i * (size_t)n, (size_t)n * sizeof(double));
    }
    if (!warm)
        tg_qp_forget(q);
    status = tg_qp_solve(q);
    q->kept = 0; /* of no plant's program */
    memcpy(x, q->x, (size_t)n * sizeof(double));
    *iterations = q->iterations;
    return status;
}

/* What a model keeps of its parameters. */
void tg_host_prepare(const double *p, double *k) { tg_model_prepare(p, k); }

/* The plant of a closed loop: a library of its own. */
typedef struct {
    void (*next)(const double *x, const double *u, const double *d, const double *k, double *xn);
    int n_x;
    double *x, *after;             /* n_x each: where it is, and room */
    const double *k, *C, *y0;      /* what its parameters fix; TG_NY rows of n_x; sensors' offsets included */
} tg_truth;

static void look(const tg_truth *plant, double *y)
{
    for (int i = 0; i < TG_NY; i++) {
        y[i] = plant->y0[i];
        for (int j = 0; j < plant->n_x; j++)
            y[i] += plant->C[i * plant->n_x + j] * plant->x[j];
    }
}

/* Surroundings of a closed loop: per_sample: the plant's steps in a sample; late: steps after which a drive
 * acts, acts: the share of it that does, both counted from the drives before; sees: share of a change that
 * sensors show at once; d: disturbances; noise: TG_NY readings' errors a sample; quanta: of each of the
 * TG_NY + TG_ND readings, 0 none; d_offset: what a sensor of a disturbance shows too much; n_relays: of drives
 * that are switched, within the plant's steps of step_s. */
typedef struct {
    int per_sample, late, n_relays;
    double sees, acts, step_s;
    const double *before, *d, *noise, *quanta, *d_offset;
    const tg_relay *relays;
    tg_switch *switches;
} tg_around;

/* What sensors show in sample t of outputs row. */
static void read_sensors(const tg_around *a, int t, const double *row, double *shown)
{
    for (int i = 0; i < TG_NY; i++)
        shown[i] = row[i] + a->noise[t * TG_NY + i];
    for (int i = 0; i < TG_ND; i++)
        shown[TG_NY + i] = a->d[i] + a->d_offset[i];
    for (int i = 0; i < TG_NY + TG_ND; i++)
        if (a->quanta[i] > 0.0)
            shown[i] = rint(shown[i] / a->quanta[i]) * a->quanta[i];
}

/* The drives as relays give them on average in a step of the plant in which these are requested. */
static void switch_drives(const tg_around *a, const double *requested, double *given)
{
    double remaining_s = a->step_s;
    memcpy(given, requested, TG_NU * sizeof(double));
    for (int i = 0; i < a->n_relays; i++)
        given[a->relays[i].drive] = 0.0;
    while (a->n_relays && remaining_s > TG_NOW_S) {
        double due_s = tg_switches_turn(a->relays, a->switches, a->n_relays, requested, 1);
        double step = fmin(remaining_s, fmax(due_s, TG_SHORTEST_S));
        for (int i = 0; i < a->n_relays; i++)
            given[a->relays[i].drive] += a->switches[i].on * a->relays[i].full * step / a->step_s;
        tg_switches_pass(a->relays, a->switches, a->n_relays, requested, step);
        remaining_s -= step;
    }
}

/* Let sample t pass under the drives given so far, TG_NU a sample; outputs go behind row. */
static void pass(const tg_around *a, tg_truth *plant, int t, const double *drive, double *row)
{
    for (int part = 0; part < a->per_sample; part++) {
        double *swap = plant->x, u[TG_NU], given[TG_NU];
        const int since = t * a->per_sample + part - a->late;
        switch_drives(a, since < 0 ? a->before : drive + since / a->per_sample * TG_NU, given);
        for (int j = 0; j < TG_NU; j++)
            u[j] = a->acts == 1.0 ? given[j] : a->before[j] + a->acts * (given[j] - a->before[j]);
        plant->next(plant->x, u, a->d, plant->k, plant->after);
        plant->x = plant->after;
        plant->after = swap;
        row += TG_NY;
        look(plant, row);
        for (int i = 0; a->sees < 1.0 && i < TG_NY; i++)
            row[i] = row[i - TG_NY] + a->sees * (row[i] - row[i - TG_NY]);
    }
}

/* A closed loop of n samples against a plant that is not the model.
 *
 * observed: the estimate that the observer starts from: x, w, P as it is kept, and found_offset, one behind the other; told: whether the controller is told of the drives before; target: n rows of n_c.
 * Into y: n per_sample + 1 rows of TG_NY, without noise and quantum; reading: n rows of TG_NY + TG_ND;
 * drive: n rows of TG_NU; status: n.
 */
void tg_host_loop(tg_controller *c, const tg_design *design, tg_truth *plant, const tg_around *around, int n, int told,
                  const double *observed, const double *target, double *y, double *reading, double *drive, int *status)
{
    look(plant, y);
    for (int t = 0; t < n; t++) {
        double *shown = reading + t * (TG_NY + TG_ND), *row = y + (size_t)t * (size_t)around->per_sample * TG_NY;
        tg_move move;
        read_sensors(around, t, row, shown);
        if (!t) {
            tg_reset(c, design, shown, shown + TG_NY);
            memcpy(c->x, observed, sizeof c->x);
            memcpy(c->w, observed + TG_NX, TG_NW * sizeof(double));
            memcpy(c->P, observed + TG_Z, sizeof c->P);
            memcpy(c->found_offset, observed + TG_Z + TG_Z * TG_Z, sizeof c->found_offset);
            c->time_s = -design->dt; /* the first reading is at 0 */
        }
        move = tg_step(c, NAN, shown, shown + TG_NY, told && !t ? around->before : NULL, target + t * design->n_c);
        memcpy(drive + t * TG_NU, move.drive, sizeof move.drive);
        status[t] = move.status;
        pass(around, plant, t, drive, row);
    }
}

/* PI loops, see thermogrip.mpc.controllers.pi: n of them, each on a drive and an output; kept: what setpoint
 * weights leave out; slew: of a sample; uncut: by which a drive may be cut
 * and not be limited; u: drives before the first sample. */
typedef struct {
    int n;
    double dt, coldest, hottest; /* readings beyond these are none */
    const int *drive, *output;
    const double *Kc, *Ti, *target, *kept, *lowest, *highest, *slew, *uncut;
    double *integral, *u;
} tg_loops;

static void step_pi(const tg_loops *p, const double *shown, double *drive)
{
    double wanted[TG_NU] = {0.0};
    for (int l = 0; l < p->n; l++)
        wanted[p->drive[l]] =
            p->Kc[l] * (p->target[l] - shown[p->output[l]] - p->kept[l]) + p->integral[l];
    for (int j = 0; j < TG_NU; j++) {
        double before = fmin(fmax(p->u[j], p->lowest[j]), p->highest[j]);
        double slewed = fmin(fmax(wanted[j], before - p->slew[j]), before + p->slew[j]);
        drive[j] = p->u[j] = fmin(fmax(slewed, p->lowest[j]), p->highest[j]);
    }
    for (int l = 0; l < p->n; l++) {
        int j = p->drive[l];
        double change = p->Kc[l] * (p->target[l] - shown[p->output[l]]), cut = drive[j] - wanted[j];
        if (cut * change > 0.0 || fabs(cut) <= p->uncut[j])
            p->integral[l] += p->dt / p->Ti[l] * change;
    }
}

/* As tg_host_loop, of PI loops; 0, and nothing that counts, where a reading is absurd. */
int tg_host_loop_pi(const tg_loops *loops, tg_truth *plant, const tg_around *around, int n, double *y, double *reading,
                    double *drive)
{
    look(plant, y);
    for (int t = 0; t < n; t++) {
        double *shown = reading + t * (TG_NY + TG_ND), *row = y + (size_t)t * (size_t)around->per_sample * TG_NY;
        read_sensors(around, t, row, shown);
        for (int i = 0; i < TG_NY; i++)
            if (!(shown[i] >= loops->coldest && shown[i] <= loops->hottest))
                return 0;
        step_pi(loops, shown, drive + t * TG_NU);
        pass(around, plant, t, drive, row);
    }
    return 1;
}
