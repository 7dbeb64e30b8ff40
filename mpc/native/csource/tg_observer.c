/* The observer: an extended Kalman filter with disturbance states.
 *
 *     x+ = f(x, u + Wu w, d + Wd w),     w+ = w,     y = C x + y0 + offset + Wy w.
 */
#include "tg_controller.h"
#include "tg_model.h"

#include <math.h>
#include <string.h>

#define LARGEST_BIAS 1.0 /* of its range: no drive makes up for more */
#define WEAK 0.05 /* of its gain at rest, below which a drive's bias is not learnt */

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

void tg_expected(const tg_controller *c, double *y)
{
    const tg_design *s = c->design;
    double on_u[TG_NU], on_d[TG_SOME(TG_ND)];
    tg_biases(c, on_u, on_d, y);
    for (int i = 0; i < TG_NY; i++) {
        double sum = s->y0[i];
        for (int j = 0; j < TG_NX; j++)
            sum += s->C[i * TG_NX + j] * c->x[j];
        y[i] += sum;
    }
}

/* H P: n_y rows; H = [C, Wy]. */
static void measure(const tg_controller *c, int i, double *row)
{
    const tg_design *s = c->design;
    memset(row, 0, TG_Z * sizeof *row);
    for (int j = 0; j < TG_Z; j++) {
        double share = j < TG_NX ? s->C[i * TG_NX + j] : s->on_output[i * TG_NW + j - TG_NX];
        if (share != 0.0)
            for (int k = 0; k < TG_Z; k++)
                row[k] += share * c->P[j * TG_Z + k];
    }
}

static double seen_by(const tg_design *s, int i, const double *row)
{
    double sum = 0.0;
    for (int j = 0; j < TG_NX; j++)
        sum += s->C[i * TG_NX + j] * row[j];
    for (int j = 0; j < TG_NW; j++)
        sum += s->on_output[i * TG_NW + j] * row[TG_NX + j];
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

/* A lost reading stands as one of which nothing is asked: its row of H P is 0. R: variances of the reading. */
static void correct(tg_controller *c, const double *y, const double *R)
{
    const tg_design *s = c->design;
    double off[TG_NY], S[TG_NY * TG_NY], HP[TG_NY * TG_Z], gain[TG_NY * TG_Z], PH[TG_NY * TG_Z];
    tg_expected(c, off);
    for (int a = 0; a < TG_NY; a++) {
        int seen = isfinite(y[a]);
        off[a] = seen ? y[a] - off[a] : 0.0;
        if (seen)
            measure(c, a, HP + a * TG_Z);
        else
            memset(HP + a * TG_Z, 0, TG_Z * sizeof(double));
    }
    for (int a = 0; a < TG_NY; a++)
        for (int b = 0; b < TG_NY; b++)
            S[a * TG_NY + b] =
                (isfinite(y[a]) ? seen_by(s, a, HP + b * TG_Z) : 0.0) + (a == b ? R[a] : 0.0);
    memcpy(gain, HP, sizeof gain);
    eliminate(S, gain); /* row a of gain: what reading a does to each state */
    for (int a = 0; a < TG_NY; a++)
        for (int j = 0; j < TG_Z; j++) {
            if (c->held[j])
                gain[a * TG_Z + j] = 0.0;
            if (j < TG_NX)
                c->x[j] += gain[a * TG_Z + j] * off[a];
            else
                c->w[j - TG_NX] += gain[a * TG_Z + j] * off[a];
        }
    for (int k = 0; k < TG_NW; k++)
        for (int j = 0; j < TG_NU; j++)
            if (s->on_drive[j * TG_NW + k] != 0.0)
                c->w[k] = fmin(fmax(c->w[k], -LARGEST_BIAS), LARGEST_BIAS);
    /* Joseph's form, right for any gain: P1 = P - K H P, P2 = P1 - P1 H'K' + K R K' */
    for (int a = 0; a < TG_NY; a++)
        for (int i = 0; i < TG_Z; i++)
            for (int j = 0; j < TG_Z; j++)
                c->P[i * TG_Z + j] -= gain[a * TG_Z + i] * HP[a * TG_Z + j];
    for (int a = 0; a < TG_NY; a++)
        for (int i = 0; i < TG_Z; i++)
            PH[a * TG_Z + i] = seen_by(s, a, c->P + i * TG_Z);
    for (int a = 0; a < TG_NY; a++)
        for (int i = 0; i < TG_Z; i++)
            for (int j = 0; j < TG_Z; j++)
                c->P[i * TG_Z + j] += (gain[a * TG_Z + i] * R[a] - PH[a * TG_Z + i]) * gain[a * TG_Z + j];
}

void tg_observer_update(tg_controller *c, const double *y) { correct(c, y, c->design->R); }

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
        if (isfinite(y[i])) {
            level += y[i] - s->offset[i];
            known++;
        }
    level = known ? level / known : (TG_ND > 0 && isfinite(d[0]) ? d[0] : 25.0);
    for (int j = 0; j < TG_NX; j++) {
        c->x[j] = s->rest[j] + s->rest_level[j] * (level - s->ambient);
        for (int i = 0; i < TG_ND; i++)
            c->x[j] += s->rest_d[j * TG_ND + i] * (d[i] - s->ambient);
    }
    memset(c->w, 0, sizeof c->w);
    memset(c->held, 0, sizeof c->held);
    memset(c->found_offset, 0, sizeof c->found_offset);
    memset(c->P, 0, sizeof c->P);
    for (int i = 0; i < TG_NX; i++)
        memcpy(c->P + i * TG_Z, s->P_rest + i * TG_NX, TG_NX * sizeof(double));
    for (int k = 0; k < TG_NW; k++)
        c->P[(TG_NX + k) * (TG_Z + 1)] = s->P0[k];
    correct(c, y, s->R_start);
    tg_observer_set_offsets(c, y, s->fixed);
}

/* The Jacobian of a sample by tangents of the unit directions; the state one sample later into next. */
static void sample_jacobian(tg_controller *c, const double *u, const double *d, double *next)
{
    const tg_design *s = c->design;
    double x[TG_NX];
    double *now = c->seed, *then = c->seed + TG_NX * TG_SEEDS, *swap;
    memset(now, 0, (size_t)TG_NX * TG_SEEDS * sizeof(double));
    memset(c->seed_u, 0, (size_t)TG_NU * TG_SEEDS * sizeof(double));
    memset(c->seed_d, 0, (size_t)TG_SOME(TG_ND) * TG_SEEDS * sizeof(double));
    for (int j = 0; j < TG_NX; j++)
        now[j * TG_SEEDS + j] = 1.0;
    for (int j = 0; j < TG_NU; j++)
        c->seed_u[j * TG_SEEDS + TG_NX + j] = 1.0;
    for (int j = 0; j < TG_ND; j++)
        c->seed_d[j * TG_SEEDS + TG_NX + TG_NU + j] = 1.0;
    memcpy(x, c->x, sizeof x);
    for (int part = 0; part < s->sub; part++) {
        tg_model_partials(x, u, d, s->k, next, c->partials);
        tg_model_tangent_d(TG_SEEDS, TG_SEEDS, c->partials, s->k, now, c->seed_u, c->seed_d, then);
        memcpy(x, next, sizeof x);
        swap = now;
        now = then;
        then = swap;
    }
    memset(c->jacobian, 0, sizeof c->jacobian);
    for (int i = 0; i < TG_NX; i++) {
        const double *row = now + i * TG_SEEDS;
        memcpy(c->jacobian + i * TG_Z, row, TG_NX * sizeof(double));
        for (int k = 0; k < TG_NW; k++) {
            double sum = 0.0;
            for (int j = 0; j < TG_NU; j++)
                sum += row[TG_NX + j] * s->on_drive[j * TG_NW + k] * s->span[j];
            for (int j = 0; j < TG_ND; j++)
                sum += row[TG_NX + TG_NU + j] * s->on_disturbance[j * TG_NW + k];
            c->jacobian[i * TG_Z + TG_NX + k] = sum;
        }
    }
    for (int k = 0; k < TG_NW; k++)
        c->jacobian[(TG_NX + k) * TG_Z + TG_NX + k] = 1.0;
}

void tg_observer_predict(tg_controller *c, const double *u, const double *d)
{
    const tg_design *s = c->design;
    double next[TG_NX] = {0.0}, on_u[TG_NU], on_d[TG_SOME(TG_ND)], on_y[TG_NY];
    tg_biases(c, on_u, on_d, on_y);
    for (int j = 0; j < TG_NU; j++)
        on_u[j] += u[j];
    for (int j = 0; j < TG_ND; j++)
        on_d[j] += d[j];
    sample_jacobian(c, on_u, on_d, next);
    memcpy(c->x, next, sizeof c->x);
    /* P = J P J' + Q; J is sparse in its last rows, and often in all */
    memset(c->spare, 0, sizeof c->spare);
    for (int i = 0; i < TG_Z; i++)
        for (int k = 0; k < TG_Z; k++) {
            double share = c->jacobian[i * TG_Z + k];
            if (share != 0.0)
                for (int j = 0; j < TG_Z; j++)
                    c->spare[i * TG_Z + j] += share * c->P[k * TG_Z + j];
        }
    for (int i = 0; i < TG_Z; i++)
        for (int j = 0; j <= i; j++) {
            double sum = 0.0;
            for (int k = 0; k < TG_Z; k++)
                sum += c->spare[i * TG_Z + k] * c->jacobian[j * TG_Z + k];
            c->P[i * TG_Z + j] = c->P[j * TG_Z + i] = sum;
        }
    for (int i = 0; i < TG_Z; i++)
        c->P[i * TG_Z + i] += c->held[i] ? 0.0 : s->Q[i];
}

void tg_hold_drives(tg_controller *c)
{
    const tg_design *s = c->design;
    for (int i = 0; i < TG_NW; i++) {
        c->held[TG_NX + i] = 0;
        for (int j = 0; j < TG_NU; j++)
            if (s->on_drive[j * TG_NW + i] != 0.0 && c->authority[j] < WEAK)
                c->held[TG_NX + i] = 1;
    }
}
