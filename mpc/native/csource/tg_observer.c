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
#define LEAST_SHARE 1e-12 /* of the trace, added to a curvature that may be 0 */
#define LEAST_TRACE 1e-300

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
static void correct(tg_controller *c, const double *y, const double *R, double remember)
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
    for (int a = 0; a < TG_NY; a++)
        if (isfinite(y[a]))
            c->innovation[a] += remember * (off[a] / sqrt(S[a * (TG_NY + 1)]) - c->innovation[a]);
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

static void correct_now(tg_controller *c, const double *y, double remember)
{
    double R[TG_NY];
    for (int i = 0; i < TG_NY; i++)
        R[i] = c->design->R[i] + c->bent[i] * c->bent[i];
    correct(c, y, R, remember);
}

void tg_observer_update(tg_controller *c, const double *y) { correct_now(c, y, TG_NEWEST_INNOVATION); }

void tg_observer_refine(tg_controller *c, const double *y) { correct_now(c, y, 0.0); }

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
    memset(c->innovation, 0, sizeof c->innovation);
    memset(c->P, 0, sizeof c->P);
    for (int i = 0; i < TG_NX; i++)
        memcpy(c->P + i * TG_Z, s->P_rest + i * TG_NX, TG_NX * sizeof(double));
    for (int k = 0; k < TG_NW; k++)
        c->P[(TG_NX + k) * (TG_Z + 1)] = s->P0[k];
    stand_on_sample(c);
    correct(c, y, s->R_start, 0.0);
    tg_observer_set_offsets(c, y, s->fixed);
}

/* Entry i of direction c, of those that are kept in groups of four. */
static double *entry(double *of, int n, int i, int c) { return of + (c / 4) * 4 * n + 4 * i + c % 4; }

/* The Jacobian of a sample by tangents of the unit directions; the state one sample later into next.
 * Returned: its entries, by states, drives and disturbances. */
static double *sample_jacobian(tg_controller *c, const double *u, const double *d, double *next)
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
    return now;
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

#define SIDES (1 + TG_NU + TG_NW)
#define ROWS (TG_NC + TG_SOME(TG_NL))

/* Solve M X = X0 (n_x rows, SIDES columns) in place, by elimination with pivots; 0 where it is singular. */
static int solve_sides(double *M, double *X)
{
    for (int p = 0; p < TG_NX; p++) {
        int best = p;
        for (int i = p + 1; i < TG_NX; i++)
            if (fabs(M[i * TG_NX + p]) > fabs(M[best * TG_NX + p]))
                best = i;
        if (!(fabs(M[best * TG_NX + p]) > 0.0))
            return 0;
        for (int j = 0; j < TG_NX; j++) {
            double swap = M[p * TG_NX + j];
            M[p * TG_NX + j] = M[best * TG_NX + j];
            M[best * TG_NX + j] = swap;
        }
        for (int j = 0; j < SIDES; j++) {
            double swap = X[p * SIDES + j];
            X[p * SIDES + j] = X[best * SIDES + j];
            X[best * SIDES + j] = swap;
        }
        for (int i = p + 1; i < TG_NX; i++) {
            double share = M[i * TG_NX + p] / M[p * TG_NX + p];
            if (share == 0.0)
                continue;
            for (int j = p; j < TG_NX; j++)
                M[i * TG_NX + j] -= share * M[p * TG_NX + j];
            for (int j = 0; j < SIDES; j++)
                X[i * SIDES + j] -= share * X[p * SIDES + j];
        }
    }
    for (int p = TG_NX - 1; p >= 0; p--)
        for (int j = 0; j < SIDES; j++) {
            double sum = X[p * SIDES + j];
            for (int i = p + 1; i < TG_NX; i++)
                sum -= M[p * TG_NX + i] * X[i * SIDES + j];
            X[p * SIDES + j] = sum / M[p * TG_NX + p];
            if (!isfinite(X[p * SIDES + j]))
                return 0;
        }
    return 1;
}

/* z between low and high that makes |weight (e - G z)| least, by coordinates in turn. */
static void squares_in_box(int n, const double *weight, const double *G, const double *e, const double *low,
                           const double *high, double *z)
{
    double H[TG_NU * TG_NU], f[TG_NU], trace = 0.0;
    for (int j = 0; j < TG_NU; j++) {
        z[j] = f[j] = 0.0;
        for (int r = 0; r < n; r++)
            f[j] += weight[r] * weight[r] * G[r * TG_NU + j] * e[r];
        for (int k = 0; k < TG_NU; k++) {
            H[j * TG_NU + k] = 0.0;
            for (int r = 0; r < n; r++)
                H[j * TG_NU + k] += weight[r] * weight[r] * G[r * TG_NU + j] * G[r * TG_NU + k];
        }
        trace += H[j * TG_NU + j];
    }
    for (int sweep = 0; sweep < TG_SWEEPS; sweep++) {
        double moved = 0.0;
        for (int j = 0; j < TG_NU; j++) {
            double slope = f[j], best;
            for (int k = 0; k < TG_NU; k++)
                slope -= H[j * TG_NU + k] * z[k];
            best = z[j] + slope / (H[j * TG_NU + j] + LEAST_SHARE * fmax(trace, LEAST_TRACE));
            best = fmin(fmax(best, low[j]), high[j]);
            moved = fmax(moved, fabs(best - z[j]));
            z[j] = best;
        }
        if (moved < 1e-9)
            break;
    }
}

/* The ends of the drives: no further than the optimiser goes where a gain falls.  G: rows of all outputs. */
static void range_of(const tg_design *s, const double *G, const double *u, const double *on_u, double *low, double *high)
{
    for (int j = 0; j < TG_NU; j++) {
        double away = u[j] - s->neutral[j], end = fabs((away < 0.0 ? s->lowest[j] : s->highest[j]) - s->neutral[j]);
        double left = s->settled_gain[j] != 0.0
                          ? G[s->controlled[s->strongest[j]] * TG_NU + j] / s->settled_gain[j] : 1.0;
        double best = fabs(away + on_u[j]) / fmax(1.0 - left, TG_FADING);
        double room = best * tg_allowed_share(end, best, s->span[j]);
        low[j] = s->lowest[j];
        high[j] = s->highest[j];
        if (left < 1.0 - TG_FADING && away < 0.0)
            low[j] = fmax(low[j], s->neutral[j] - room);
        if (left < 1.0 - TG_FADING && away > 0.0)
            high[j] = fmin(high[j], s->neutral[j] + room);
        low[j] = fmin(fmax((low[j] - u[j]) / s->span[j], -TG_STRIDE), TG_STRIDE);
        high[j] = fmax(fmin((high[j] - u[j]) / s->span[j], TG_STRIDE), low[j]);
    }
}

/* The change z of the drives, in ranges, that brings the outputs y nearest to targets and limits. */
static void nearest(const tg_controller *c, const double *G, const double *y, const double *low, const double *high,
                    double *z)
{
    const tg_design *s = c->design;
    int rows = s->n_c + s->n_l;
    double own[ROWS * TG_NU] = {0.0}, e[ROWS] = {0.0}, weight[ROWS] = {0.0}, over[ROWS] = {0.0};
    for (int r = 0; r < s->n_c; r++)
        weight[r] = c->unread_s[r] > 0.0 ? 0.0 : 1.0;
    for (int pass = 0, changed = 1; pass < rows && changed; pass++) {
        for (int r = 0; r < rows; r++) {
            int i = r < s->n_c ? s->controlled[r] : s->limited[r - s->n_c];
            double end = r < s->n_c ? c->target[r] : over[r] > 0.0 ? s->limit_high[r - s->n_c] : s->limit_low[r - s->n_c];
            e[r] = end - y[i];
            memcpy(own + r * TG_NU, G + i * TG_NU, TG_NU * sizeof(double));
        }
        squares_in_box(rows, weight, own, e, low, high, z);
        changed = 0;
        for (int r = 0; r < rows; r++) {
            int i = r < s->n_c ? s->controlled[r] : s->limited[r - s->n_c];
            double value = y[i], before = r < s->n_c ? weight[r] : over[r], near = TG_CAN * s->unit[i];
            for (int j = 0; j < TG_NU; j++)
                value += G[i * TG_NU + j] * z[j];
            if (r < s->n_c) {
                if (weight[r] > 0.0 && c->side[r] * (value - c->target[r]) > near)
                    weight[r] = sqrt(s->price * (TG_FIRST + 1.0) / s->track); /* what 1 degC costs the optimiser */
                changed = changed || weight[r] != before;
                continue;
            }
            if (value > s->limit_high[r - s->n_c] + near)
                over[r] = 1.0;
            if (value < s->limit_low[r - s->n_c] - near)
                over[r] = -1.0;
            weight[r] = over[r] != 0.0 ? TG_BEYOND_LIMIT : 0.0;
            changed = changed || over[r] != before;
        }
    }
}

/* The steady state as seen from x: what is missing of it in X, a column by each drive and bias behind, and the outputs
 * there, y, by the drives, G; 0 where there is none. */
static int look_for_steady(tg_controller *c, const double *x, const double *u, const double *d, const double *on_u,
                           double *X, double *y, double *G)
{
    const tg_design *s = c->design;
    double keep[TG_NX], both[TG_NU], next[TG_NX] = {0.0}, *slopes;
    for (int j = 0; j < TG_NU; j++)
        both[j] = u[j] + on_u[j];
    memcpy(keep, c->x, sizeof keep);
    memcpy(c->x, x, sizeof keep);
    slopes = sample_jacobian(c, both, d, next);
    memcpy(c->x, keep, sizeof keep);
    for (int i = 0; i < TG_NX; i++) {
        for (int j = 0; j < TG_NX; j++)
            c->spare[i * TG_NX + j] = (i == j ? 1.0 : 0.0) - *entry(slopes, TG_NX, i, j);
        X[i * SIDES] = next[i] - x[i];
        for (int j = 0; j < TG_NU; j++)
            X[i * SIDES + 1 + j] = *entry(slopes, TG_NX, i, TG_NX + j) * s->span[j];
        for (int k = 0; k < TG_NW; k++)
            X[i * SIDES + 1 + TG_NU + k] = c->jacobian[i * TG_Z + TG_NX + k];
    }
    if (!solve_sides(c->spare, X))
        return 0;
    for (int r = 0; r < TG_NY; r++) {
        const double *C = s->C + r * TG_NX;
        y[r] = s->y0[r];
        for (int i = 0; i < TG_NX; i++) {
            y[r] += C[i] * (x[i] + X[i * SIDES]);
            for (int j = 0; j < TG_NU; j++)
                G[r * TG_NU + j] += C[i] * X[i * SIDES + 1 + j];
        }
    }
    return 1;
}

/* The same outputs of a plant that is linear, and settles. */
static void settle(const tg_design *s, const double *u, const double *d, const double *on_u, double *y, double *G)
{
    for (int r = 0; r < TG_NY; r++) {
        const double *by = s->settled_by + r * TG_NV;
        y[r] = s->settled[r];
        for (int j = 0; j < TG_NU; j++) {
            G[r * TG_NU + j] = by[j];
            y[r] += by[j] * (u[j] + on_u[j]) / s->span[j];
        }
        for (int j = 0; j < TG_ND; j++)
            y[r] += by[TG_NU + j] * d[j];
    }
}

int tg_find_steady(tg_controller *c, const double *d, const double *on_u, const double *on_y, double *held, double *by_w)
{
    const tg_design *s = c->design;
    double x[TG_NX], u[TG_NU], X[TG_NX * SIDES] = {0.0};
    double G[TG_NY * TG_NU] = {0.0}, y[TG_NY] = {0.0}, low[TG_NU] = {0.0}, high[TG_NU] = {0.0}, z[TG_NU] = {0.0};
    double largest = 0.0;
    int found = 0;
    for (int i = 0; i < TG_NY; i++)
        largest = fmax(largest, s->unit[i]);
    memcpy(x, c->has_steady ? c->steady_x : tg_now(c), sizeof x);
    memcpy(u, c->has_steady ? c->steady_u : c->u, sizeof u);
    c->has_steady = 0;
    for (int j = 0; j < TG_NU; j++)
        u[j] = fmin(fmax(u[j], s->lowest[j]), s->highest[j]);
    for (int step = 0; step < TG_STEADY_STEPS && !found; step++) {
        double moved = 0.0;
        memset(G, 0, sizeof G);
        if (s->settles)
            settle(s, u, d, on_u, y, G);
        else if (!look_for_steady(c, x, u, d, on_u, X, y, G))
            return 0;
        for (int r = 0; r < TG_NY; r++)
            y[r] += on_y[r];
        range_of(s, G, u, on_u, low, high);
        nearest(c, G, y, low, high, z);
        for (int i = 0; i < TG_NX && !s->settles; i++) {
            moved = fmax(moved, fabs(X[i * SIDES]) / largest);
            x[i] += X[i * SIDES];
            for (int j = 0; j < TG_NU; j++)
                x[i] += X[i * SIDES + 1 + j] * z[j];
        }
        for (int j = 0; j < TG_NU; j++) {
            moved = fmax(moved, fabs(z[j]));
            u[j] += z[j] * s->span[j];
        }
        found = moved < TG_CONVERGED;
    }
    for (int r = 0; r < s->n_c; r++) {
        int i = s->controlled[r];
        held[r] = y[i];
        for (int j = 0; j < TG_NU; j++)
            held[r] += G[i * TG_NU + j] * z[j];
        for (int k = 0; k < TG_NW; k++) {
            double *by = by_w + r * TG_SOME(TG_NW) + k;
            *by = s->on_output[i * TG_NW + k] + (s->settles ? s->settled_by[i * TG_NV + TG_NU + TG_ND + k] : 0.0);
            for (int j = 0; j < TG_NX && !s->settles; j++)
                *by += s->C[i * TG_NX + j] * X[j * SIDES + 1 + TG_NU + k];
        }
    }
    memcpy(c->steady_x, x, sizeof x);
    memcpy(c->steady_u, u, sizeof u);
    c->has_steady = found;
    return found;
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
        c->P[i * TG_Z + i] += c->held[i] ? 0.0 : share * c->design->Q[i];
    for (int i = 0; i < TG_NX; i++)
        for (int j = 0; j < TG_NX; j++)
            for (int k = 0; k < TG_NU; k++)
                c->P[i * TG_Z + j] += share * c->design->load[i * TG_NU + k] * c->design->load[j * TG_NU + k];
}

/* P = J P J', twice by rows of J, which is sparse in its last rows, and often in all: J P, and J times its transpose,
 * of whose rows, which are symmetric, the second half is the first of others. */
static void carry_covariance(tg_controller *c)
{
    int from[TG_Z], to[TG_Z];
    memset(c->spare, 0, sizeof c->spare);
    for (int i = 0; i < TG_Z; i++) {
        find_band(c->jacobian + i * TG_Z, from + i, to + i);
        add_rows(c->spare + i * TG_Z, c->jacobian + i * TG_Z, from[i], to[i], c->P, TG_Z);
    }
    for (int i = 0; i < TG_Z; i++)
        for (int j = 0; j < i; j++) {
            double swap = c->spare[i * TG_Z + j];
            c->spare[i * TG_Z + j] = c->spare[j * TG_Z + i];
            c->spare[j * TG_Z + i] = swap;
        }
    memset(c->P, 0, sizeof c->P);
    for (int i = 0; i < TG_Z; i++) {
        int n = TG_WHOLE(i + 1) < TG_Z ? TG_WHOLE(i + 1) : TG_Z;
        add_rows(c->P + i * TG_Z, c->jacobian + i * TG_Z, from[i], to[i], c->spare, n);
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
