/* What a program that loads this code as a library calls: the parts by pointers to plain arrays, and a whole
 * closed loop against another plant. Not part of an export. */
#include "tg_controller.h"
#include "tg_model.h"
#include "tg_truth.h"

#include <math.h>
#include <string.h>

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
int *tg_host_held(tg_controller *c) { return c->held; }
void tg_host_forget(tg_controller *c)
{
    tg_qp_forget(&c->qp);
    c->solves = 0;
}

int tg_host_optimise(tg_controller *c, const double *x, const double *last, const double *guess,
                     const double *d, const double *target, const double *side, const double *bias,
                     const double *drive_bias, double *plan, double *y, double *authority, int *iterations)
{
    int status = tg_optimise(c, x, last, guess, d, target, side, bias, drive_bias);
    memcpy(plan, c->best, (size_t)c->qp.n * sizeof(double));
    memcpy(y, c->y_best, (size_t)c->design->N * TG_NY * sizeof(double));
    memcpy(authority, c->authority, (size_t)c->qp.n * sizeof(double));
    *iterations = c->iterations;
    return status;
}

/* One QP of n unknowns and s soft rows (A: s rows of n), for tests. */
int tg_host_qp(tg_controller *c, int n, int s, const double *H, const double *f, const double *lower,
               const double *upper, const double *A, double linear, double quadratic, int warm, double *x,
               int *iterations)
{
    tg_qp *q = &c->qp;
    int status;
    q->n = n;
    q->stride = TG_NU;
    q->s = s;
    q->linear = linear;
    q->quadratic = quadratic;
    q->iteration_limit = 500;
    for (int i = 0; i < n; i++)
        memcpy(q->H + (size_t)i * TG_Q_N, H + (size_t)i * (size_t)n, (size_t)(i + 1) * sizeof(double));
    memcpy(q->f, f, (size_t)n * sizeof(double));
    memcpy(q->lower, lower, (size_t)(2 * n + s) * sizeof(double));
    memcpy(q->upper, upper, (size_t)(2 * n + s) * sizeof(double));
    for (int i = 0; i < s; i++) {
        q->filled[i] = n;
        memcpy(q->A + (size_t)i * TG_Q_N, A + (size_t)i * (size_t)n, (size_t)n * sizeof(double));
    }
    if (!warm)
        tg_qp_forget(q);
    status = tg_qp_solve(q);
    memcpy(x, q->x, (size_t)n * sizeof(double));
    *iterations = q->iterations;
    return status;
}

/* What a model keeps of its parameters. */
void tg_host_prepare(const double *p, double *k) { tg_model_prepare(p, k); }

/* A closed loop of n samples against a plant that is not the model.
 *
 * x: the plant's state at the start (TG_NX), where it ends afterwards; observed: the state that the observer
 * starts from; p: the plant's parameters; per_sample: native steps in a sample, of which the first `late` still
 * run on the drive before; noise: n rows of TG_NY readings' errors; quantum: of a reading, 0 none;
 * y_offset, d_offset: what a sensor shows too much; target: n rows of n_c.
 * Into y: n per_sample + 1 rows of TG_NY, without noise and quantum; reading: n rows of TG_NY + TG_ND;
 * drive: n rows of TG_NU; status: n.
 */
void tg_host_loop(tg_controller *c, const tg_design *design, int n, int per_sample, int late, double *x,
                  const double *observed, const double *p, const double *d, const double *noise, double quantum,
                  const double *y_offset, const double *d_offset, const double *target, double *y,
                  double *reading, double *drive, int *status)
{
    double k[TG_TRUTH_NK > 0 ? TG_TRUTH_NK : 1], next[TG_NX], u[TG_NU];
    tg_truth_prepare(p, k);
    for (int i = 0; i < TG_NY; i++) {
        y[i] = design->y0[i] + y_offset[i];
        for (int j = 0; j < TG_NX; j++)
            y[i] += design->C[i * TG_NX + j] * x[j];
    }
    memcpy(u, design->neutral, sizeof u);
    for (int t = 0; t < n; t++) {
        double *shown = reading + t * (TG_NY + TG_ND);
        tg_move move;
        for (int i = 0; i < TG_NY + TG_ND; i++) {
            shown[i] = i < TG_NY ? y[(size_t)t * (size_t)per_sample * TG_NY + (size_t)i] + noise[t * TG_NY + i]
                                 : d[i - TG_NY] + d_offset[i - TG_NY];
            if (quantum > 0.0)
                shown[i] = rint(shown[i] / quantum) * quantum;
        }
        if (!t) {
            tg_reset(c, design, shown, shown + TG_NY);
            memcpy(c->x, observed, sizeof c->x);
        }
        move = tg_step(c, NAN, shown, shown + TG_NY, NULL, target + t * design->n_c);
        memcpy(drive + t * TG_NU, move.drive, sizeof move.drive);
        status[t] = move.status;
        for (int part = 0; part < per_sample; part++) {
            double *row = y + ((size_t)t * (size_t)per_sample + (size_t)part + 1) * TG_NY;
            tg_truth_next(x, part < late ? u : move.drive, d, k, next);
            memcpy(x, next, sizeof next);
            for (int i = 0; i < TG_NY; i++) {
                row[i] = design->y0[i] + y_offset[i];
                for (int j = 0; j < TG_NX; j++)
                    row[i] += design->C[i * TG_NX + j] * x[j];
            }
        }
        memcpy(u, move.drive, sizeof u);
    }
}
