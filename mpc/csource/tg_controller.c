/* The loop around the optimiser: estimate, decide, and an answer whatever happens. */
#include "tg_controller.h"
#include "tg_model.h"

#include <math.h>
#include <string.h>

#define RESTART_S 30.0 /* a longer silence than this and the past is unknown */
#define WEAK 0.15      /* of its gain at rest, below which a drive's bias is not learnt */
#define SPIKE 6.0      /* degC off the prediction in one sample: a loose plug, unless it stays */
#define COLDEST (-60.0)
#define HOTTEST 200.0
#define TINY 1e-9

/* ---- observer: x+ = f(x, u + Wu w, d + Wd w), w+ = w, y = Cx + y0 + offset + Wy w ---- */

static void biases(const tg_controller *c, double *on_u, double *on_d, double *on_y)
{
    const tg_design *s = c->design;
    for (int j = 0; j < TG_NU; j++) {
        double sum = 0.0;
        for (int i = 0; i < TG_NW; i++)
            sum += s->on_drive[j * TG_NW + i] * c->w[i];
        /* a bias beyond a third of the range is no longer a small error of the model */
        on_u[j] = fmin(fmax(sum, -0.3), 0.3) * s->span[j];
    }
    for (int j = 0; j < TG_ND; j++) {
        on_d[j] = 0.0;
        for (int i = 0; i < TG_NW; i++)
            on_d[j] += s->on_disturbance[j * TG_NW + i] * c->w[i];
    }
    for (int j = 0; j < TG_NY; j++) {
        on_y[j] = s->offset[j];
        for (int i = 0; i < TG_NW; i++)
            on_y[j] += s->on_output[j * TG_NW + i] * c->w[i];
    }
}

static void expected(const tg_controller *c, double *y)
{
    const tg_design *s = c->design;
    double on_u[TG_NU], on_d[TG_SOME(TG_ND)];
    biases(c, on_u, on_d, y);
    for (int i = 0; i < TG_NY; i++) {
        double sum = s->y0[i];
        for (int j = 0; j < TG_NX; j++)
            sum += s->C[i * TG_NX + j] * c->x[j];
        y[i] += sum;
    }
}

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
        double sum = s->rest[j];
        for (int i = 0; i < TG_NY; i++)
            sum += s->rest_y[j * TG_NY + i] * ((isfinite(y[i]) ? y[i] - s->offset[i] : level) - s->ambient);
        for (int i = 0; i < TG_ND; i++)
            sum += s->rest_d[j * TG_ND + i] * (d[i] - s->ambient);
        c->x[j] = sum;
    }
    memset(c->w, 0, sizeof c->w);
    memset(c->held, 0, sizeof c->held);
    memset(c->P, 0, sizeof c->P);
    for (int j = 0; j < TG_Z; j++)
        c->P[j * TG_Z + j] = s->P0[j];
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

/* A lost reading stands as one of which nothing is asked: its row of H P is 0. */
void tg_observer_update(tg_controller *c, const double *y)
{
    const tg_design *s = c->design;
    double off[TG_NY], S[TG_NY * TG_NY], HP[TG_NY * TG_Z], gain[TG_NY * TG_Z], PH[TG_NY * TG_Z];
    expected(c, off);
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
                (isfinite(y[a]) ? seen_by(s, a, HP + b * TG_Z) : 0.0) + (a == b ? s->R[a] : 0.0);
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
                c->P[i * TG_Z + j] += (gain[a * TG_Z + i] * s->R[a] - PH[a * TG_Z + i]) * gain[a * TG_Z + j];
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
    biases(c, on_u, on_d, on_y);
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

static void hold_drives(tg_controller *c)
{
    const tg_design *s = c->design;
    for (int i = 0; i < TG_NW; i++) {
        c->held[TG_NX + i] = 0;
        for (int j = 0; j < TG_NU; j++)
            if (s->on_drive[j * TG_NW + i] != 0.0 && c->authority[j] < WEAK)
                c->held[TG_NX + i] = 1;
    }
}

/* ---- the loop ---- */

static double clean(double value) { return value >= COLDEST && value <= HOTTEST ? value : NAN; }

static int all_finite(const double *a, int n)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(a[i]))
            return 0;
    return 1;
}

static void start(tg_controller *c, const double *y, const double *d)
{
    const tg_design *s = c->design;
    for (int i = 0; i < TG_ND; i++)
        c->d[i] = isfinite(d[i]) ? d[i] : s->ambient;
    tg_observer_reset(c, y, c->d);
    for (int j = 0; j < TG_NU; j++)
        c->u[j] = c->in_force[j] = s->neutral[j];
    for (int r = 0; r < TG_NC; r++) {
        c->target[r] = NAN;
        c->side[r] = 0.0;
    }
    c->has_plan = c->spikes = c->solves = 0;
    c->age_s = c->blind_s = 0.0;
    c->time_s = NAN;
    c->fresh = 1;
    memcpy(c->y, y, sizeof c->y);
    tg_qp_forget(&c->qp);
}

void tg_reset(tg_controller *c, const tg_design *design, const double *y, const double *d)
{
    double clean_y[TG_NY], clean_d[TG_SOME(TG_ND)];
    memset(c, 0, sizeof *c);
    c->design = design;
    for (int i = 0; i < TG_NY; i++)
        clean_y[i] = clean(y[i]);
    for (int i = 0; i < TG_ND; i++)
        clean_d[i] = clean(d[i]);
    start(c, clean_y, clean_d);
}

/* Time since the last step [s]; 0 where the reading is stale. */
static double elapsed(tg_controller *c, double now)
{
    double before = c->time_s, dt = c->design->dt;
    if (!isfinite(now))
        return dt;
    c->time_s = now;
    if (!isfinite(before))
        return dt;
    if (now <= before)
        return 0.0;
    if (now - before < 0.5 * dt)
        c->time_s = before; /* the sample that counts is still to come */
    return now - before;
}

void tg_advance_plan(tg_controller *c)
{
    int n = c->design->N;
    c->age_s += c->design->dt;
    if (c->has_plan) /* its last sample stays, twice */
        memmove(c->plan, c->plan + TG_NU, (size_t)(n - 1) * TG_NU * sizeof(double));
}

/* Bring the estimate up to this reading; return what the operator should know. */
static int absorb(tg_controller *c, double seconds, double *y, const double *d, const double *applied)
{
    const tg_design *s = c->design;
    double mean[TG_NY];
    int spike = 0, any = 0, lost = 0, blind = 0;
    for (int i = 0; i < TG_NY; i++)
        any = any || isfinite(y[i]);
    if (seconds > RESTART_S + s->dt && any) {
        double known[TG_SOME(TG_ND)], u[TG_NU], target[TG_NC], side[TG_NC], now = c->time_s;
        for (int i = 0; i < TG_ND; i++)
            known[i] = isfinite(d[i]) ? d[i] : c->d[i];
        memcpy(u, c->u, sizeof u);
        memcpy(target, c->target, sizeof target);
        memcpy(side, c->side, sizeof side);
        start(c, y, known);
        memcpy(c->u, u, sizeof u);
        memcpy(c->in_force, applied, sizeof c->in_force);
        memcpy(c->target, target, sizeof target);
        memcpy(c->side, side, sizeof side);
        c->fresh = 0;
        c->time_s = now;
        return TG_RESTARTED;
    }
    if (!c->fresh) {
        /* without a reading to start from, no more is predicted than a silence that would count */
        long times = lrint(fmin(seconds, RESTART_S) / s->dt);
        for (long at = 0; at < (times > 1 ? times : 1); at++) {
            tg_observer_predict(c, applied, c->d);
            tg_advance_plan(c);
        }
    }
    c->fresh = 0;
    if (!s->move_delay) /* the slew limit counts from what was really applied */
        memcpy(c->u, applied, sizeof c->u);
    for (int i = 0; i < TG_ND; i++)
        if (isfinite(d[i]))
            c->d[i] = d[i];
    expected(c, mean);
    for (int i = 0; i < TG_NY; i++)
        spike = spike || fabs(y[i] - mean[i]) > SPIKE;
    c->spikes = spike ? c->spikes + 1 : 0;
    if (c->spikes > 3) { /* it stays, so it is the world that has changed */
        tg_observer_reset(c, y, c->d);
        c->spikes = 0;
    } else if (spike)
        for (int i = 0; i < TG_NY; i++)
            if (fabs(y[i] - mean[i]) > SPIKE)
                y[i] = NAN;
    tg_observer_update(c, y);
    memcpy(c->y, y, sizeof c->y);
    for (int i = 0; i < TG_NY; i++)
        lost = lost || !isfinite(y[i]);
    for (int i = 0; i < TG_ND; i++)
        lost = lost || !isfinite(d[i]);
    for (int r = 0; r < s->n_c; r++)
        blind = blind || !isfinite(y[s->controlled[r]]);
    c->blind_s = blind ? c->blind_s + seconds : 0.0;
    return lost ? TG_LOST_READING : TG_ALL_WELL;
}

static int set_target(tg_controller *c, const double *target)
{
    const tg_design *s = c->design;
    double mean[TG_NY], wanted;
    int wrong = 0, moved = 0;
    for (int r = 0; r < s->n_c; r++) {
        wanted = clean(target[r]);
        wrong = wrong || !isfinite(wanted);
        if (isfinite(wanted) && wanted != c->target[r])
            moved = 1;
        if (!isfinite(wanted) && !isfinite(c->target[r]))
            moved = 1;
    }
    expected(c, mean);
    for (int r = 0; r < s->n_c; r++) {
        wanted = isfinite(clean(target[r])) ? target[r] : c->target[r];
        if (moved) {
            double far = wanted - mean[s->controlled[r]];
            c->side[r] = far > 0.0 ? 1.0 : far < 0.0 ? -1.0 : 0.0;
        }
        c->target[r] = wanted;
    }
    return wrong;
}

void tg_guess(const tg_controller *c, const double *last, double *guess)
{
    const tg_design *s = c->design;
    int k = 0;
    for (int b = 0; b < s->n_b; b++, k += s->blocks[b - 1])
        for (int j = 0; j < TG_NU; j++) {
            double sum = 0.0;
            for (int at = 0; at < s->blocks[b]; at++)
                sum += c->plan[(k + at) * TG_NU + j];
            guess[b * TG_NU + j] = c->has_plan ? sum / s->blocks[b] : last[j];
        }
}

static int optimise(tg_controller *c)
{
    const tg_design *s = c->design;
    double last[TG_NU], guess[TG_Q_N], x[TG_NX], u[TG_NU], d[TG_SOME(TG_ND)], on_u[TG_NU], on_y[TG_NY];
    biases(c, on_u, d, on_y);
    for (int i = 0; i < TG_ND; i++)
        d[i] += c->d[i];
    for (int j = 0; j < TG_NU; j++) {
        last[j] = fmin(fmax(c->u[j], s->lowest[j]), s->highest[j]);
        u[j] = last[j] + on_u[j];
    }
    memcpy(x, c->x, sizeof x);
    for (int part = 0; s->move_delay && part < s->sub; part++) { /* the drive applied now stays one sample more */
        double next[TG_NX];
        tg_model_next(x, u, d, s->k, next);
        memcpy(x, next, sizeof x);
    }
    tg_guess(c, last, guess);
    return tg_optimise(c, x, last, guess, d, c->target, c->side, on_y, on_u);
}

static void follow(tg_controller *c, tg_move *move, int status, int advice)
{
    move->status = status;
    move->advice = advice;
    if (c->has_plan && c->age_s <= c->design->patience_s) {
        memcpy(move->drive, c->plan, sizeof move->drive);
        return;
    }
    memcpy(move->drive, c->design->neutral, sizeof move->drive);
    move->status = TG_OFF;
}

static void go_blind(tg_controller *c, tg_move *move)
{
    move->status = TG_FALLBACK_PLAN;
    if (c->blind_s <= c->design->patience_s) {
        memcpy(move->drive, c->has_plan ? c->plan : c->u, sizeof move->drive);
        return;
    }
    c->has_plan = 0;
    memcpy(move->drive, c->design->neutral, sizeof move->drive);
    move->status = TG_OFF;
    move->advice = TG_BLIND;
}

void tg_keep_plan(tg_controller *c)
{
    const tg_design *s = c->design;
    int k = 0;
    for (int b = 0; b < s->n_b; b++)
        for (int at = 0; at < s->blocks[b]; at++, k++)
            memcpy(c->plan + k * TG_NU, c->best + b * TG_NU, TG_NU * sizeof(double));
    c->has_plan = 1;
    c->age_s = 0.0;
}

static void decide(tg_controller *c, tg_move *move)
{
    const tg_design *s = c->design;
    int outside = 0;
    move->status = TG_OK;
    move->advice = TG_ALL_WELL;
    memcpy(move->drive, s->neutral, sizeof move->drive);
    if (!all_finite(c->target, s->n_c)) {
        move->status = TG_OFF;
        move->advice = TG_NO_TARGET;
        return;
    }
    if (c->blind_s > 0.0) {
        go_blind(c, move);
        return;
    }
    for (int j = 0; j < TG_NU; j++)
        outside = outside || c->u[j] < s->lowest[j] - TINY || c->u[j] > s->highest[j] + TINY;
    optimise(c);
    move->iterations = c->iterations;
    hold_drives(c);
    if (c->qp_status != TG_QP_SOLVED) {
        follow(c, move, c->qp_status == TG_QP_INFEASIBLE ? TG_INFEASIBLE : TG_FALLBACK_PLAN, TG_SOLVER);
        return;
    }
    tg_keep_plan(c);
    memcpy(move->drive, c->best, sizeof move->drive);
    if (outside) {
        move->status = TG_INFEASIBLE;
        move->advice = TG_OUT_OF_RANGE;
    } else if (c->broken > 0.1) {
        move->status = c->broken > 0.5 ? TG_INFEASIBLE : TG_OK;
        move->advice = TG_LIMIT_BREAKS;
        move->over = c->broken;
    }
}

/* Finite, in range, and within the slew limit; range wins over slew. */
static void keep_within(const tg_controller *c, double *u)
{
    const tg_design *s = c->design;
    for (int j = 0; j < TG_NU; j++) {
        double value = isfinite(u[j]) ? u[j] : s->neutral[j];
        double before = fmin(fmax(c->u[j], s->lowest[j]), s->highest[j]);
        value = fmin(fmax(value, before - s->slew[j]), before + s->slew[j]);
        u[j] = fmin(fmax(value, s->lowest[j]), s->highest[j]);
    }
}

static void set_pump(tg_move *move)
{
    move->pump = move->status != TG_OFF;
    for (int j = 0; j < TG_NU; j++)
        move->pump = move->pump || move->drive[j] != 0.0;
}

tg_move tg_step(tg_controller *c, double time_s, const double *y, const double *d, const double *applied,
                const double *target)
{
    tg_move move;
    double seconds = elapsed(c, time_s), dt = c->design->dt;
    double clean_y[TG_NY], clean_d[TG_SOME(TG_ND)], did[TG_NU], in_force[TG_NU];
    int said, wrong;
    memset(&move, 0, sizeof move);
    if (seconds > 0.0 && seconds < 0.5 * dt) {
        memcpy(move.drive, c->u, sizeof move.drive);
        move.advice = TG_TOO_EARLY;
        set_pump(&move);
        return move;
    }
    for (int i = 0; i < TG_NY; i++)
        clean_y[i] = seconds > 0.0 ? clean(y[i]) : NAN;
    for (int i = 0; i < TG_ND; i++)
        clean_d[i] = clean(d[i]);
    for (int j = 0; j < TG_NU; j++)
        did[j] = applied && isfinite(applied[j]) ? applied[j] : c->in_force[j];
    said = absorb(c, fmax(seconds, dt), clean_y, clean_d, did);
    if (said == TG_ALL_WELL && !(seconds > 0.0))
        said = TG_STALE;
    memcpy(in_force, c->u, sizeof in_force);
    wrong = set_target(c, target);
    decide(c, &move);
    if (wrong && move.status == TG_OK)
        move.status = TG_INFEASIBLE;
    if (wrong)
        move.advice = TG_BAD_TARGET;
    else if (move.advice == TG_ALL_WELL)
        move.advice = said;
    keep_within(c, move.drive);
    memcpy(c->u, move.drive, sizeof c->u);
    /* where the computer is slow, the drive of now goes on while the new one is worked out */
    memcpy(c->in_force, c->design->move_delay ? in_force : c->u, sizeof c->in_force);
    set_pump(&move);
    return move;
}

const char *tg_status_text(int status)
{
    static const char *const text[] = {"ok", "late", "infeasible", "fallback_plan", "fallback_pi", "off"};
    return status >= TG_OK && status <= TG_OFF ? text[status] : "?";
}

const char *tg_advice_text(int advice)
{
    static const char *const text[] = {
        "",
        "called before its sample time: the move is held",
        "reading is stale: its time has not moved on",
        "no reading for long: the estimate was started again",
        "a reading is lost or absurd",
        "no target yet: drive to zero",
        "a target is missing or absurd: the last good one stands",
        "no reading for too long: check the sensor",
        "the optimiser failed: the last plan goes on, then the drive is off",
        "the drive that was applied is out of range: brought back",
        "a limit of an output will be broken: choose a nearer target",
    };
    return advice >= TG_ALL_WELL && advice <= TG_LIMIT_BREAKS ? text[advice] : "?";
}
