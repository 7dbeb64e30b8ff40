/* The loop around the optimiser: estimate, decide, and an answer whatever happens. */
#include "tg_controller.h"
#include "tg_model.h"

#include <math.h>
#include <string.h>

#define RESTART_S 30.0 /* a longer silence than this and the past is unknown */
#define SPIKE 6.0      /* degC off the prediction in one sample: a loose plug, unless it stays */
#define LEFT_OUT 3     /* samples in a row, at most, that a jump is left out for */
#define STUCK 2.0      /* degC that the model expects of a reading that has not moved at all */
#define OFF 0.5        /* degC from the target, below which being out of reach is not worth a word */
#define NEARER 0.05    /* degC that a plan must win over the horizon to count as coming nearer */
#define FOLLOWS_DRIVE 0.3   /* of its range: a larger bias of a drive is not a small error of the model */
#define FOLLOWS_OUTPUT 2.0  /* degC: a larger bias of an output is not a small error of the model */
#define COLDEST (-60.0)
#define HOTTEST 200.0
#define TINY 1e-9

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
    c->has_plan = c->solves = c->on_pi = 0;
    memset(c->spikes, 0, sizeof c->spikes);
    c->age_s = c->blind_s = c->idle_s = 0.0;
    memset(c->moved, 0, sizeof c->moved);
    memcpy(c->last_y, y, sizeof c->last_y);
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

/* Note by how much the model moves the outputs in a sample. */
static void expect(tg_controller *c, const double *before)
{
    const tg_design *s = c->design;
    for (int i = 0; i < TG_NY; i++)
        for (int j = 0; j < TG_NX; j++)
            c->moved[i] += s->C[i * TG_NX + j] * (c->x[j] - before[j]);
}

/* Leave out readings that stay the same while the model expects them to move. */
static int drop_stuck(tg_controller *c, double *y)
{
    int stuck = 0;
    for (int i = 0; i < TG_NY; i++) {
        if (isfinite(y[i]) && !(y[i] == c->last_y[i]))
            c->moved[i] = 0.0;
        if (isfinite(y[i]))
            c->last_y[i] = y[i];
        if (fabs(c->moved[i]) > STUCK) {
            y[i] = NAN;
            stuck = 1;
        }
    }
    return stuck;
}

/* Leave out jumps, for some samples; one that stays is an offset of its sensor, or another world. */
static int screen(tg_controller *c, double *y)
{
    double mean[TG_NY];
    int stays[TG_NY], count = 0, seen = 0;
    tg_expected(c, mean);
    for (int i = 0; i < TG_NY; i++) {
        int jumped = fabs(y[i] - mean[i]) > SPIKE;
        if (jumped)
            c->spikes[i]++;
        else if (isfinite(y[i]))
            c->spikes[i] = 0;
        stays[i] = c->spikes[i] > LEFT_OUT;
        if (stays[i])
            c->spikes[i] = 0;
        else if (jumped)
            y[i] = NAN;
        count += stays[i];
        seen += isfinite(y[i]) != 0;
    }
    if (!count)
        return TG_ALL_WELL;
    if (2 * count < seen) {
        tg_observer_set_offsets(c, y, stays);
        return TG_SENSOR_OFFSET;
    }
    tg_observer_reset(c, y, c->d);
    return TG_WORLD_CHANGED;
}

/* Bring the estimate up to this reading; return what the operator should know. */
static int absorb(tg_controller *c, double seconds, double *y, const double *d, const double *applied)
{
    const tg_design *s = c->design;
    int any = 0, lost = 0, blind = 0, stuck, jumped;
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
            double before[TG_NX];
            memcpy(before, c->x, sizeof before);
            tg_observer_predict(c, applied, c->d);
            expect(c, before);
            tg_advance_plan(c);
        }
    }
    c->fresh = 0;
    if (!s->move_delay) /* the slew limit counts from what was really applied */
        memcpy(c->u, applied, sizeof c->u);
    for (int i = 0; i < TG_ND; i++)
        if (isfinite(d[i]))
            c->d[i] = d[i];
    stuck = drop_stuck(c, y);
    jumped = screen(c, y);
    tg_observer_update(c, y);
    memcpy(c->y, y, sizeof c->y);
    for (int i = 0; i < TG_NY; i++)
        lost = lost || !isfinite(y[i]);
    for (int i = 0; i < TG_ND; i++)
        lost = lost || !isfinite(d[i]);
    for (int r = 0; r < s->n_c; r++)
        blind = blind || !isfinite(y[s->controlled[r]]);
    c->blind_s = blind ? c->blind_s + seconds : 0.0;
    if (jumped != TG_ALL_WELL)
        return jumped;
    return lost ? (stuck ? TG_STUCK : TG_LOST_READING) : TG_ALL_WELL;
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
    tg_expected(c, mean);
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
    tg_biases(c, on_u, d, on_y);
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

/* Whether there is a plan to follow. */
static int is_young(const tg_controller *c)
{
    return c->has_plan && c->age_s <= c->design->patience_s && !c->on_pi;
}

static int time_is_up(const tg_controller *c) { return c->late && c->late(c->about); }

static double error_of(const tg_controller *c, int loop)
{
    const tg_design *s = c->design;
    int r = s->loop_output[loop];
    return c->target[r] - c->y[s->controlled[r]];
}

/* One step of the PI controller, taken over without a bump: u = Kc e + I, I+ = I + dt (Kc/Ti e + (u - v)/Tt). */
static void go_on_pi(tg_controller *c, double *drive)
{
    const tg_design *s = c->design;
    double wanted[TG_NU] = {0.0};
    for (int l = 0; l < s->n_loops && !c->on_pi; l++)
        c->integral[l] = c->u[s->loop_drive[l]] - s->Kc[l] * error_of(c, l);
    c->on_pi = 1;
    for (int l = 0; l < s->n_loops; l++)
        wanted[s->loop_drive[l]] = s->Kc[l] * error_of(c, l) + c->integral[l];
    for (int j = 0; j < TG_NU; j++) {
        double before = fmin(fmax(c->u[j], s->lowest[j]), s->highest[j]);
        double low = fmax(s->lowest[j], before - s->slew[j]), high = fmin(s->highest[j], before + s->slew[j]);
        drive[j] = fmin(fmax(wanted[j], low), high);
    }
    for (int l = 0; l < s->n_loops; l++) {
        int j = s->loop_drive[l];
        c->integral[l] += s->dt * (s->Kc[l] / s->Ti[l] * error_of(c, l) + (drive[j] - wanted[j]) / s->Tt[l]);
    }
}

/* Follow the plan while it is young; then PI, then off. */
static void follow(tg_controller *c, tg_move *move, int status, int advice)
{
    const tg_design *s = c->design;
    int blind = s->n_loops == 0;
    move->status = status;
    move->advice = advice;
    if (is_young(c)) {
        memcpy(move->drive, c->plan, sizeof move->drive);
        return;
    }
    for (int r = 0; r < s->n_c; r++)
        blind = blind || !isfinite(c->y[s->controlled[r]]);
    if (blind) {
        memcpy(move->drive, s->neutral, sizeof move->drive);
        move->status = TG_OFF;
        return;
    }
    go_on_pi(c, move->drive);
    if (status == TG_FALLBACK_PLAN)
        move->status = TG_FALLBACK_PI;
}

/* Whether no plan has come nearer to a target for longer than patience. */
static int out_of_reach(tg_controller *c)
{
    const tg_design *s = c->design;
    double mean[TG_NY];
    int hopeless = 0;
    tg_expected(c, mean);
    for (int r = 0; r < s->n_c; r++) {
        int i = s->controlled[r];
        double far = c->target[r] - mean[i], ahead = c->y_best[(s->N - 1) * TG_NY + i] - mean[i];
        hopeless = hopeless || (fabs(far) > OFF && (far > 0.0 ? ahead : -ahead) < NEARER);
    }
    c->idle_s = hopeless ? c->idle_s + s->dt : 0.0;
    return c->idle_s > s->patience_s;
}

/* Whether the plant is the model no longer. */
static int strays(const tg_controller *c)
{
    const tg_design *s = c->design;
    for (int j = 0; j < TG_NU; j++) {
        double sum = 0.0;
        for (int i = 0; i < TG_NW; i++)
            sum += s->on_drive[j * TG_NW + i] * c->w[i];
        if (fabs(sum) >= FOLLOWS_DRIVE)
            return 1;
    }
    for (int j = 0; j < TG_NY; j++) {
        double sum = c->found_offset[j];
        for (int i = 0; i < TG_NW; i++)
            sum += s->on_output[j * TG_NW + i] * c->w[i];
        if (fabs(sum) >= FOLLOWS_OUTPUT)
            return 1;
    }
    return 0;
}

static void go_blind(tg_controller *c, tg_move *move)
{
    move->status = TG_FALLBACK_PLAN;
    if (c->blind_s <= c->design->patience_s) {
        memcpy(move->drive, is_young(c) ? c->plan : c->u, sizeof move->drive);
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
    c->on_pi = 0;
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
    if (time_is_up(c)) {
        follow(c, move, TG_LATE, TG_TOO_LATE);
        return;
    }
    for (int j = 0; j < TG_NU; j++)
        outside = outside || c->u[j] < s->lowest[j] - TINY || c->u[j] > s->highest[j] + TINY;
    optimise(c);
    move->iterations = c->iterations;
    tg_hold_drives(c);
    if (c->qp_status != TG_QP_SOLVED) {
        if (c->qp_status == TG_QP_TIME)
            follow(c, move, TG_LATE, TG_TOO_LATE);
        else
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
    } else if (out_of_reach(c)) {
        move->status = TG_INFEASIBLE;
        move->advice = TG_OUT_OF_REACH;
    } else if (time_is_up(c)) {
        move->status = TG_LATE;
        move->advice = TG_TOO_LATE;
    } else if (strays(c))
        move->advice = s->switched ? TG_PUMP : TG_NOT_FOLLOWING;
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
    if (move.status == TG_OK && said != TG_ALL_WELL)
        move.advice = said; /* what happened in this sample, before what has been so for long */
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
        "the optimiser failed: the last plan goes on, then PI",
        "the drive that was applied is out of range: brought back",
        "a limit of an output will be broken: choose a nearer target",
        "a reading does not move though it should: is the sensor stuck?",
        "no drive brings the output nearer to its target: choose a nearer one",
        "the plant does not follow the model: is it another one, is the sensor in place?",
        "the deadline passed: the last plan goes on, then PI",
        "a jump of a reading stays: taken for an offset of the sensor",
        "a jump of the readings stays: the estimate was started again",
        "the plant does not follow the model: does the pump run, is the sensor in place?",
    };
    return advice >= TG_ALL_WELL && advice <= TG_PUMP ? text[advice] : "?";
}
