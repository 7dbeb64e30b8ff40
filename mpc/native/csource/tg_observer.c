/* The observer: an extended Kalman filter with disturbance states.
 *
 *     x+ = f(x, u + Wu w, d + Wd w),     w+ = w,     y = C x + y0 + offset + Wy w.
 *
 * x is kept on a grid of samples, because a delay of shift registers advances by whole samples only;
 * a reading the share s of a sample after it is one of (1 - s) x + s f(x, u, d), u the mean of the drives since.
 */
#include "tg_controller.h"
#include "tg_model.h"

#include <math.h>
#include <string.h>

#define ROUNDED 1e-16 /* of the length of a row, that its sum is rounded by at least */

static double output(const tg_controller *c, int i, const double *x)
{
    double sum = c->design->y0[i];
    for (int j = c->design->read_from[i]; j < c->design->read_to[i]; j++)
        sum += c->design->C[i * TG_NX + j] * x[j];
    return sum;
}

/* What the disturbance states add to drives, measured disturbances and outputs. */
void tg_biases(const tg_controller *c, double *on_u, double *on_d, double *on_y)
{
    const tg_design *s = c->design;
    for (int j = 0; j < TG_NU; j++) {
        double sum = 0.0;
        for (int i = 0; i < TG_NW; i++)
            sum += s->on_drive[j * TG_NW + i] * c->w[i];
        on_u[j] = sum * s->span[j];
    }
    for (int j = 0; j < TG_ND; j++) {
        on_d[j] = 0.0;
        for (int i = 0; i < TG_NW; i++)
            on_d[j] += s->on_disturbance[j * TG_NW + i] * c->w[i];
    }
    for (int j = 0; j < TG_NY; j++) {
        on_y[j] = s->offset[j] + c->found_offset[j];
        for (int i = 0; i < TG_NW; i++)
            on_y[j] += s->on_output[j * TG_NW + i] * c->w[i];
    }
}

const double *tg_now(const tg_controller *c) { return c->share > 0.0 ? c->ahead : c->x; }

void tg_expected(const tg_controller *c, double *y)
{
    double on_u[TG_NU], on_d[TG_SOME(TG_ND)];
    tg_biases(c, on_u, on_d, y);
    for (int i = 0; i < TG_NY; i++)
        y[i] += output(c, i, tg_now(c));
}

static void stand_on_sample(tg_controller *c)
{
    c->into_s = c->share = c->noised = 0.0;
    memset(c->dose, 0, sizeof c->dose);
    memset(c->bent, 0, sizeof c->bent);
}

/* What reading i is of the states; between two samples times the derivative of the state there. */
static void sensitivity(const tg_controller *c, int i, double *h)
{
    const tg_design *s = c->design;
    double plain[TG_Z];
    memcpy(plain, s->C + i * TG_NX, TG_NX * sizeof *plain);
    for (int j = 0; j < TG_NW; j++)
        plain[TG_NX + j] = s->on_output[i * TG_NW + j];
    if (!(c->share > 0.0)) {
        memcpy(h, plain, sizeof plain);
        return;
    }
    memset(h, 0, TG_Z * sizeof *h);
    for (int j = 0; j < TG_Z; j++)
        if (plain[j] != 0.0)
            for (int k = 0; k < TG_Z; k++)
                h[k] += plain[j] * c->jacobian[j * TG_Z + k];
}

/* Add the rows of M that a row of a matrix asks for, n numbers each, four at a time; it is 0 but from..to. */
static void add_rows(double *restrict into, const double *row, int from, int to, const double *restrict M, int n)
{
    int k = from;
    for (; k + 4 <= to; k += 4) {
        const double *M0 = M + k * TG_Z, *M1 = M0 + TG_Z, *M2 = M1 + TG_Z, *M3 = M2 + TG_Z;
        const double s0 = row[k], s1 = row[k + 1], s2 = row[k + 2], s3 = row[k + 3];
        if (s0 == 0.0 && s1 == 0.0 && s2 == 0.0 && s3 == 0.0)
            continue;
        for (int j = 0; j < n; j++)
            into[j] += s0 * M0[j] + s1 * M1[j] + (s2 * M2[j] + s3 * M3[j]);
    }
    for (; k < to; k++)
        for (int j = 0; row[k] != 0.0 && j < n; j++)
            into[j] += row[k] * M[k * TG_Z + j];
}

/* h P. */
static void measure(const tg_controller *c, const double *h, double *row)
{
    memset(row, 0, TG_Z * sizeof *row);
    add_rows(row, h, 0, TG_Z, c->P, TG_Z);
}

static double seen_by(const double *h, const double *row)
{
    double sum = 0.0;
    for (int j = 0; j < TG_Z; j++)
        sum += h[j] * row[j];
    return sum;
}

/* Solve S X = B (symmetric positive, X has TG_Z columns) in place, by elimination. */
static void eliminate(double *S, double *B)
{
    for (int p = 0; p < TG_NY; p++)
        for (int i = p + 1; i < TG_NY; i++) {
            double share = S[i * TG_NY + p] / S[p * TG_NY + p];
            for (int j = p; j < TG_NY; j++)
                S[i * TG_NY + j] -= share * S[p * TG_NY + j];
            for (int j = 0; j < TG_Z; j++)
                B[i * TG_Z + j] -= share * B[p * TG_Z + j];
        }
    for (int p = TG_NY - 1; p >= 0; p--)
        for (int j = 0; j < TG_Z; j++) {
            double sum = B[p * TG_Z + j];
            for (int i = p + 1; i < TG_NY; i++)
                sum -= S[p * TG_NY + i] * B[i * TG_Z + j];
            B[p * TG_Z + j] = sum / S[p * TG_NY + p];
        }
}

/* Change the states. */
static void apply(tg_controller *c, double *change)
{
    const tg_design *s = c->design;
    for (int k = 0; k < TG_NW; k++) {
        double w = c->w[k] + change[TG_NX + k];
        for (int j = 0; j < TG_NU; j++)
            if (s->on_drive[j * TG_NW + k] != 0.0)
                w = fmin(fmax(w, -TG_LARGEST_BIAS), TG_LARGEST_BIAS);
        change[TG_NX + k] = w - c->w[k];
        c->w[k] = w;
    }
    for (int i = 0; c->share > 0.0 && i < TG_NX; i++)
        c->ahead[i] += seen_by(c->jacobian + i * TG_Z, change);
    for (int i = 0; i < TG_NX; i++)
        c->x[i] += change[i];
}

static void add_two(double *restrict into, double a, const double *restrict x, double b, const double *restrict y)
{
    for (int j = 0; j < TG_Z; j++)
        into[j] += a * x[j] + b * y[j];
}

/* Correct the estimate by a reading of variances R.  A lost one is given no weight: its row of H P is 0. */
static void correct(tg_controller *c, const double *y, const double *R)
{
    double off[TG_NY], S[TG_NY * TG_NY], HP[TG_NY * TG_Z], gain[TG_NY * TG_Z], back[TG_NY * TG_Z];
    double HPH[TG_NY * TG_NY], H[TG_NY * TG_Z], change[TG_Z] = {0.0};
    tg_expected(c, off);
    for (int a = 0; a < TG_NY; a++)
        sensitivity(c, a, H + a * TG_Z);
    for (int a = 0; a < TG_NY; a++) {
        int seen = isfinite(y[a]);
        off[a] = seen ? y[a] - off[a] : 0.0;
        if (seen)
            measure(c, H + a * TG_Z, HP + a * TG_Z);
        else
            memset(HP + a * TG_Z, 0, TG_Z * sizeof(double));
    }
    for (int a = 0; a < TG_NY; a++)
        for (int b = 0; b < TG_NY; b++) {
            HPH[a * TG_NY + b] = isfinite(y[a]) ? seen_by(H + a * TG_Z, HP + b * TG_Z) : 0.0;
            S[a * TG_NY + b] = HPH[a * TG_NY + b] + (a == b ? R[a] : 0.0);
        }
    memcpy(gain, HP, sizeof gain);
    eliminate(S, gain); /* row a of gain: what reading a does to each state */
    for (int a = 0; a < TG_NY; a++)
        for (int j = 0; j < TG_Z; j++) {
            if (c->held[j])
                gain[a * TG_Z + j] = 0.0;
            change[j] += gain[a * TG_Z + j] * off[a];
        }
    /* Joseph's form, right for any gain K: P - K HP + (K R - P1 H') K', P1 = P - K HP, P1 H' = PH' - K HPH' */
    for (int a = 0; a < TG_NY; a++)
        for (int i = 0; i < TG_Z; i++) {
            double left = gain[a * TG_Z + i] * R[a] - HP[a * TG_Z + i];
            for (int b = 0; b < TG_NY; b++)
                left += gain[b * TG_Z + i] * HPH[b * TG_NY + a];
            back[a * TG_Z + i] = left;
        }
    for (int a = 0; a < TG_NY; a++)
        for (int i = 0; i < TG_Z; i++)
            add_two(c->P + i * TG_Z, -gain[a * TG_Z + i], HP + a * TG_Z, back[a * TG_Z + i], gain + a * TG_Z);
    apply(c, change);
}

void tg_observer_update(tg_controller *c, const double *y)
{
    double R[TG_NY];
    for (int i = 0; i < TG_NY; i++)
        R[i] = c->design->R[i] + c->bent[i] * c->bent[i];
    correct(c, y, R);
}

void tg_observer_set_offsets(tg_controller *c, const double *y, const int *which)
{
    double mean[TG_NY];
    tg_expected(c, mean);
    for (int i = 0; i < TG_NY; i++)
        if (which[i] && isfinite(y[i]))
            c->found_offset[i] += y[i] - mean[i];
}

/* Start at rest: one update of a plant that may have been held by any drive, whose sensors may be off. */
void tg_observer_reset(tg_controller *c, const double *y, const double *d)
{
    const tg_design *s = c->design;
    double level = 0.0;
    int known = 0;
    for (int i = 0; i < TG_NY; i++)
        if (s->warm[i] && isfinite(y[i])) {
            level += y[i] - s->offset[i];
            known++;
        }
    level = known ? level / known : (s->room >= 0 && isfinite(d[s->room]) ? d[s->room] : 25.0);
    for (int j = 0; j < TG_NX; j++) {
        c->x[j] = s->rest[j] + s->rest_level[j] * (level - s->ambient);
        for (int i = 0; i < TG_ND; i++)
            c->x[j] += s->rest_d[j * TG_ND + i] * (d[i] - s->usual_d[i]);
    }
    memset(c->w, 0, sizeof c->w);
    memset(c->held, 0, sizeof c->held);
    memset(c->found_offset, 0, sizeof c->found_offset);
    memset(c->P, 0, sizeof c->P);
    for (int i = 0; i < TG_NX; i++)
        memcpy(c->P + i * TG_Z, s->P_rest + i * TG_NX, TG_NX * sizeof(double));
    for (int k = 0; k < TG_NW; k++)
        c->P[(TG_NX + k) * (TG_Z + 1)] = s->P0[k];
    stand_on_sample(c);
    correct(c, y, s->R_start);
    tg_observer_set_offsets(c, y, s->fixed);
}

/* Entry i of direction c, of those that are kept in groups of four. */
static double *entry(double *of, int n, int i, int c) { return of + (c / 4) * 4 * n + 4 * i + c % 4; }

/* The Jacobian of a sample by tangents of the unit directions; the state one sample later into next. */
static void sample_jacobian(tg_controller *c, const double *u, const double *d, double *next)
{
    const tg_design *s = c->design;
    double x[TG_NX];
    double *now = c->seed, *then = c->seed + TG_NX * TG_WIDE, *swap;
    memset(now, 0, (size_t)TG_NX * TG_WIDE * sizeof(double));
    memset(c->seed_u, 0, sizeof c->seed_u);
    memset(c->seed_d, 0, sizeof c->seed_d);
    for (int j = 0; j < TG_NX; j++)
        *entry(now, TG_NX, j, j) = 1.0;
    for (int j = 0; j < TG_NU; j++)
        *entry(c->seed_u, TG_NU, j, TG_NX + j) = 1.0;
    for (int j = 0; j < TG_ND; j++)
        *entry(c->seed_d, TG_ND, j, TG_NX + TG_NU + j) = 1.0;
    memcpy(x, c->x, sizeof x);
    tg_model_hold_slopes(1, u, s->k, c->by_drives);
    for (int part = 0; part < s->sub; part++) {
        tg_model_partials(x, u, d, s->k, c->by_drives, next, c->partials);
        tg_model_tangent_d((TG_SEEDS + 3) / 4, c->partials, s->k, c->by_drives, now, c->seed_u, c->seed_d, then);
        memcpy(x, next, sizeof x);
        swap = now;
        now = then;
        then = swap;
    }
    memset(c->jacobian, 0, sizeof c->jacobian);
    for (int i = 0; i < TG_NX; i++) {
        for (int j = 0; j < TG_NX; j++)
            c->jacobian[i * TG_Z + j] = *entry(now, TG_NX, i, j);
        for (int k = 0; k < TG_NW; k++) {
            double sum = 0.0;
            for (int j = 0; j < TG_NU; j++)
                sum += *entry(now, TG_NX, i, TG_NX + j) * s->on_drive[j * TG_NW + k] * s->span[j];
            for (int j = 0; j < TG_ND; j++)
                sum += *entry(now, TG_NX, i, TG_NX + TG_NU + j) * s->on_disturbance[j * TG_NW + k];
            c->jacobian[i * TG_Z + TG_NX + k] = sum;
        }
    }
    for (int k = TG_NX; k < TG_Z; k++)
        c->jacobian[k * (TG_Z + 1)] = 1.0;
    c->has_jacobian = 1;
}

/* The state one sample later into next, and the Jacobian, which of a linear plant stays. */
static void look_ahead(tg_controller *c, const double *u, const double *d, double *next)
{
    const tg_design *s = c->design;
    double x[TG_NX];
    if (!s->linear || !c->has_jacobian) {
        sample_jacobian(c, u, d, next);
        return;
    }
    memcpy(x, c->x, sizeof x);
    tg_model_hold(1, u, s->k, c->by_drives);
    for (int part = 0; part < s->sub; part++) {
        tg_model_step(x, u, d, s->k, c->by_drives, next);
        memcpy(x, next, sizeof x);
    }
}

/* Where a row of the Jacobian begins and ends: what is left out is less than what its sums are rounded by. */
static void find_band(const double *row, int *from, int *to)
{
    double least = 0.0;
    for (int j = 0; j < TG_Z; j++)
        least += row[j] * row[j];
    least *= ROUNDED * ROUNDED;
    for (*from = 0; *from < TG_Z && row[*from] * row[*from] <= least;)
        ++*from;
    for (*to = TG_Z; *to > *from && row[*to - 1] * row[*to - 1] <= least;)
        --*to;
}

/* Add what a share of a sample adds to the covariance. */
static void add_noise(tg_controller *c, double share)
{
    for (int i = 0; i < TG_Z; i++)
        for (int j = 0; j < TG_Z; j++) /* a bias that is held drifts no more, and does with no other state */
            c->P[i * TG_Z + j] += c->held[j] ? 0.0 : share * c->design->Q[i * TG_Z + j];
}

/* P = J P J', twice by rows of J, which is sparse in its last rows, and often in all: J P, and J times its transpose,
 * of whose rows, which are symmetric, the second half is the first of others. */
static void carry_covariance(tg_controller *c)
{
    int from[TG_Z], to[TG_Z];
    double *half = c->seed; /* of no use any more once there is a Jacobian */
    memset(half, 0, TG_Z * TG_Z * sizeof(double));
    for (int i = 0; i < TG_Z; i++) {
        find_band(c->jacobian + i * TG_Z, from + i, to + i);
        add_rows(half + i * TG_Z, c->jacobian + i * TG_Z, from[i], to[i], c->P, TG_Z);
    }
    for (int i = 0; i < TG_Z; i++)
        for (int j = 0; j < i; j++) {
            double swap = half[i * TG_Z + j];
            half[i * TG_Z + j] = half[j * TG_Z + i];
            half[j * TG_Z + i] = swap;
        }
    memset(c->P, 0, sizeof c->P);
    for (int i = 0; i < TG_Z; i++) {
        int n = TG_WHOLE(i + 1) < TG_Z ? TG_WHOLE(i + 1) : TG_Z;
        add_rows(c->P + i * TG_Z, c->jacobian + i * TG_Z, from[i], to[i], half, n);
    }
    for (int i = 0; i < TG_Z; i++)
        for (int j = 0; j < i; j++)
            c->P[j * TG_Z + i] = c->P[i * TG_Z + j];
}

void tg_observer_predict(tg_controller *c, const double *u, const double *d)
{
    double next[TG_NX] = {0.0}, on_u[TG_NU], on_d[TG_SOME(TG_ND)] = {0.0}, on_y[TG_NY];
    tg_biases(c, on_u, on_d, on_y);
    for (int j = 0; j < TG_NU; j++)
        on_u[j] += u[j];
    for (int j = 0; j < TG_ND; j++)
        on_d[j] += d[j];
    look_ahead(c, on_u, on_d, next);
    memcpy(c->x, next, sizeof c->x);
    carry_covariance(c);
    add_noise(c, 1.0 - c->noised);
    stand_on_sample(c);
}

/* Let seconds pass: whole samples, each under the mean of its drives, and a rest. */
void tg_observer_advance(tg_controller *c, double seconds, const double *u, const double *d)
{
    double dt = c->design->dt, left = seconds, mean[TG_NU];
    while (c->into_s + left >= dt * (1.0 - TG_SAME)) {
        double rest = dt - c->into_s;
        for (int j = 0; j < TG_NU; j++)
            mean[j] = c->into_s <= TG_SAME * dt ? u[j] : (c->dose[j] + rest * u[j]) / dt;
        tg_observer_predict(c, mean, d);
        left -= rest;
    }
    c->into_s += left;
    for (int j = 0; j < TG_NU; j++)
        c->dose[j] += left * u[j];
}

/* Evaluate the state at the present time, between two samples: readings are compared there. */
void tg_observer_look(tg_controller *c, const double *d)
{
    const tg_design *s = c->design;
    double next[TG_NX] = {0.0}, on_u[TG_NU], on_d[TG_SOME(TG_ND)] = {0.0}, on_y[TG_NY];
    double share = c->into_s / s->dt;
    if (share <= TG_SAME)
        return;
    tg_biases(c, on_u, on_d, on_y);
    for (int j = 0; j < TG_NU; j++)
        on_u[j] += c->dose[j] / c->into_s;
    for (int j = 0; j < TG_ND; j++)
        on_d[j] += d[j];
    look_ahead(c, on_u, on_d, next);
    for (int i = 0; i < TG_NX; i++)
        c->ahead[i] = (1.0 - share) * c->x[i] + share * next[i];
    add_noise(c, share - c->noised);
    for (int i = 0; i < TG_Z; i++)
        for (int j = 0; j < TG_Z; j++)
            c->jacobian[i * TG_Z + j] = share * c->jacobian[i * TG_Z + j] + (i == j ? 1.0 - share : 0.0);
    c->has_jacobian = 0;
    for (int i = 0; i < TG_NY; i++)
        c->bent[i] = 4.0 * share * (1.0 - share) * (output(c, i, next) - output(c, i, c->x));
    c->share = c->noised = share;
}

void tg_hold_drives(tg_controller *c)
{
    const tg_design *s = c->design;
    for (int i = 0; i < TG_NW; i++) {
        c->held[TG_NX + i] = 0;
        for (int j = 0; j < TG_NU; j++)
            if (s->on_drive[j * TG_NW + i] != 0.0 && c->authority[j] < TG_WEAK)
                c->held[TG_NX + i] = 1;
    }
}
