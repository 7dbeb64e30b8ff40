/* The loop around the optimiser: estimate, decide, and an answer whatever happens. */
#include "tg_controller.h"
#include "tg_model.h"

#include <math.h>
#include <string.h>

#define TINY 1e-9

/* ---- the loop ---- */

static double clean(const tg_design *s, double value)
{
    return value >= s->coldest && value <= s->hottest ? value : NAN;
}

static double clean_measured(const tg_design *s, int i, double value)
{
    return value >= s->least_d[i] && value <= s->most_d[i] ? value : NAN;
}

static int all_finite(const double *a, int n)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(a[i]))
            return 0;
    return 1;
}

static void forget_calls(tg_controller *c)
{
    c->time_s = c->back_s = NAN;
    c->interval_s = c->design->dt;
    c->repeats = c->stale = 0;
    c->passed_s = c->since_s = c->assumed_s = c->spent_s = c->waited_s = c->slew_s = 0.0;
    c->stood_s = c->before_s = c->unspent_s = 0.0;
}

/* Start the estimate again; drives in force and targets stay. */
static void start(tg_controller *c, const double *y, const double *d)
{
    const tg_design *s = c->design;
    for (int i = 0; i < TG_ND; i++)
        c->d[i] = isfinite(d[i]) ? d[i] : s->usual_d[i];
    tg_observer_reset(c, y, c->d);
    for (int r = 0; r < TG_NC; r++)
        c->ramped[r] = NAN;
    c->ramps = 0;
    c->has_plan = c->solves = c->on_pi = 0;
    memset(c->spikes, 0, sizeof c->spikes);
    c->age_s = c->silent_s = 0.0;
    memset(c->unread_s, 0, sizeof c->unread_s);
    memset(c->lost, 0, sizeof c->lost);
    memset(c->moved, 0, sizeof c->moved);
    memcpy(c->last_y, y, sizeof c->last_y);
    c->fresh = 1;
    memcpy(c->y, y, sizeof c->y);
    memcpy(c->seen, c->x, sizeof c->seen);
    tg_qp_forget(&c->qp);
}

void tg_reset(tg_controller *c, const tg_design *design, const double *y, const double *d)
{
    double clean_y[TG_NY], clean_d[TG_SOME(TG_ND)];
    memset(c, 0, sizeof *c);
    c->design = design;
    for (int i = 0; i < TG_NY; i++)
        clean_y[i] = clean(design, y[i]);
    for (int i = 0; i < TG_ND; i++)
        clean_d[i] = clean_measured(design, i, d[i]);
    for (int j = 0; j < TG_NU; j++)
        c->u[j] = design->neutral[j];
    for (int r = 0; r < TG_NC; r++)
        c->target[r] = NAN;
    start(c, clean_y, clean_d);
    forget_calls(c);
}

/* Note a call at this time: the seconds that passed, each once, whether a move is due, and for how many seconds
 * the slew limit counts.  A stale reading gives no elapsed time; such a call is taken to be as
 * far from the last as calls usually are.  A clock that went back by far and runs on from there was restarted. */
static void note_call(tg_controller *c, tg_time now)
{
    const tg_time before = c->time_s;
    double dt = c->design->dt, passed;
    c->passed_s = 0.0;
    c->stale = 0;
    if (!isfinite(now)) {
        c->passed_s = dt;
        c->time_s += dt;
    } else if (!isfinite(before)) {
        c->passed_s = dt;
        c->time_s = now;
    } else if (now > before) {
        c->passed_s = (double)(now - before);
        c->time_s = now;
    } else if (before - now > TG_RESTART_S && now > c->back_s) {
        c->passed_s = (double)(now - c->back_s) + c->interval_s;
        c->time_s = now;
    } else
        c->stale = 1;
    c->back_s = c->stale ? now : NAN;
    if (c->stale) {
        c->repeats++;
        c->assumed_s += c->interval_s;
        passed = c->waited_s = c->since_s + c->assumed_s - c->spent_s;
    } else {
        c->interval_s = c->passed_s / (1 + c->repeats);
        c->repeats = 0;
        c->since_s += c->passed_s;
        c->stood_s += c->passed_s;
        passed = c->since_s + c->before_s;
        c->waited_s = fmax(c->since_s - c->spent_s, fmin(c->since_s, dt));
    }
    c->slew_s = c->waited_s;
    if (c->stale || c->passed_s > TG_RESTART_S + dt) /* elapsed time and drives are unknown */
        c->slew_s = fmin(c->slew_s, dt);
    c->due = passed >= dt * (1.0 - TG_SAME) - 0.5 * c->interval_s;
}

/* Note a move to these drives.  After one between two samples the next is due where it was before: there the
 * estimate stands on its grid. */
static void note_move(tg_controller *c, const double *drive)
{
    double used = 0.0; /* samples of slew */
    for (int j = 0; j < TG_NU; j++)
        used = fmax(used, fabs(drive[j] - c->u[j]) / c->design->slew[j]);
    c->unspent_s = fmax(c->slew_s - used * c->design->dt, 0.0);
    memcpy(c->u, drive, sizeof c->u);
    c->before_s = c->stale || c->due ? 0.0 : c->before_s + c->since_s;
    if (c->stale)
        c->spent_s = c->since_s + c->assumed_s;
    else
        c->since_s = c->assumed_s = c->spent_s = 0.0;
}

/* Let estimate and plan go on by the seconds that passed under the drives that were applied. */
static void pass(tg_controller *c, const double *applied)
{
    double seconds = c->passed_s;
    if (c->fresh)
        return; /* the estimate begins with this reading */
    if (seconds > TG_RESTART_S + c->design->dt) {
        /* until a reading comes to start again from, no more is predicted than a silence that would count */
        c->silent_s = seconds;
        seconds = TG_RESTART_S;
    }
    tg_observer_advance(c, seconds, applied, c->d);
    c->age_s += seconds;
}

/* Note by how much the model has moved the outputs since the last reading. */
static void expect(tg_controller *c)
{
    const tg_design *s = c->design;
    const double *x = tg_now(c);
    for (int i = 0; i < TG_NY; i++)
        for (int j = 0; j < TG_NX; j++)
            c->moved[i] += s->C[i * TG_NX + j] * (x[j] - c->seen[j]);
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
        if (fabs(c->moved[i]) > TG_SHARE * c->design->spike[i]) {
            y[i] = NAN;
            stuck = 1;
        }
    }
    return stuck;
}

/* Reject jumps, for some samples; one that stays is an offset of its sensor, or a change of the plant. */
static int screen(tg_controller *c, double *y)
{
    double mean[TG_NY];
    int *stays = c->stays, count = 0, seen = 0;
    tg_expected(c, mean);
    for (int i = 0; i < TG_NY; i++) {
        int jumped = fabs(y[i] - mean[i]) > c->design->spike[i];
        if (jumped)
            c->spikes[i]++;
        else if (isfinite(y[i]))
            c->spikes[i] = 0;
        stays[i] = c->spikes[i] > TG_LEFT_OUT;
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

/* Correct the estimate with a reading that comes before a move is due; no jump of it counts. */
static void refine(tg_controller *c, double *y)
{
    double mean[TG_NY];
    int any = 0;
    for (int i = 0; i < TG_NY; i++)
        any = any || isfinite(y[i]);
    if (c->fresh || !any)
        return;
    tg_observer_look(c, c->d);
    expect(c);
    drop_stuck(c, y);
    tg_expected(c, mean);
    for (int i = 0; i < TG_NY; i++)
        if (fabs(y[i] - mean[i]) > c->design->spike[i])
            y[i] = NAN;
    tg_observer_update(c, y);
    memcpy(c->seen, tg_now(c), sizeof c->seen);
}

/* Correct the estimate with this reading; return what the operator should know, and how long nobody called. */
static int absorb(tg_controller *c, double *y, const double *d, const double *applied, double *silent)
{
    const tg_design *s = c->design;
    int any = 0, lost = 0, stuck, jumped;
    *silent = c->silent_s;
    for (int i = 0; i < TG_NY; i++)
        any = any || isfinite(y[i]);
    if (c->silent_s > 0.0 && any) {
        double known[TG_SOME(TG_ND)];
        for (int i = 0; i < TG_ND; i++)
            known[i] = isfinite(d[i]) ? d[i] : c->d[i];
        start(c, y, known);
        c->fresh = 0;
        return TG_RESTARTED;
    }
    if (!c->fresh) {
        tg_observer_look(c, c->d);
        expect(c);
    }
    c->fresh = 0;
    memcpy(c->u, applied, sizeof c->u); /* the slew limit counts from what was really applied */
    for (int i = 0; i < TG_ND; i++)
        if (isfinite(d[i]))
            c->d[i] = d[i];
    stuck = drop_stuck(c, y);
    jumped = screen(c, y);
    tg_observer_update(c, y);
    memcpy(c->y, y, sizeof c->y);
    memcpy(c->seen, tg_now(c), sizeof c->seen);
    for (int i = 0; i < TG_NY; i++)
        lost = lost || !isfinite(y[i]);
    for (int i = 0; i < TG_ND; i++)
        lost = lost || !isfinite(d[i]);
    for (int r = 0; r < s->n_c; r++)
        c->unread_s[r] = isfinite(y[s->controlled[r]]) ? 0.0 : c->unread_s[r] + c->waited_s;
    if (jumped != TG_ALL_WELL)
        return jumped;
    return lost ? (stuck ? TG_STUCK : TG_LOST_READING) : TG_ALL_WELL;
}

/* Whether a target is another one than at the last move. */
static int is_new(const tg_controller *c, const double *target)
{
    for (int r = 0; r < c->design->n_c; r++)
        if (isfinite(clean(c->design, target[r])) && target[r] != c->target[r])
            return 1;
    return 0;
}

/* Whether this call moves the drives: a sample time is over, or a target that stood for one is another now.
 * One that changes at every call, or whose samples ahead are known, is followed at the sample time. */
static int moves(tg_controller *c, const double *target)
{
    int other = !c->goals && is_new(c, target);
    int at_once = other && !c->stale && c->stood_s >= c->design->dt * (1.0 - TG_SAME);
    if (other && (c->due || at_once))
        c->stood_s = 0.0;
    if (at_once && !c->due) /* what the last move left of its slew counts */
        c->slew_s = fmin(c->waited_s + c->unspent_s, c->design->dt);
    return c->due || at_once;
}

/* Note whence the outputs come to their targets. */
static void take_sides(tg_controller *c)
{
    double mean[TG_NY];
    tg_expected(c, mean);
    for (int r = 0; r < c->design->n_c; r++) {
        double far = c->target[r] - mean[c->design->controlled[r]];
        c->side[r] = far > 0.0 ? 1.0 : far < 0.0 ? -1.0 : 0.0;
    }
}

/* Take targets, the last good one where one cannot be; return whether there is such a one. */
static int set_target(tg_controller *c, const double *target)
{
    int wrong = 0, other = is_new(c, target);
    for (int r = 0; r < c->design->n_c; r++)
        if (isfinite(clean(c->design, target[r])))
            c->target[r] = target[r];
        else
            wrong = 1;
    if (other)
        take_sides(c);
    return wrong;
}

/* Where targets that may only ramp are now, and in the samples ahead, towards what is asked then. */
static void ramp(tg_controller *c)
{
#if TG_NR > 0
    const tg_design *s = c->design;
    c->ramps = c->goals != NULL;
    for (int r = 0; r < s->n_c; r++) {
        double begun = isfinite(c->ramped[r]) ? c->ramped[r] : c->y[s->controlled[r]], reach = s->ramp[r] * c->waited_s;
        c->ramped[r] = c->target[r];
        if (s->ramp[r] > 0.0 && isfinite(begun))
            c->ramped[r] = fmin(fmax(c->target[r], begun - reach), begun + reach);
        c->ramps = c->ramps || c->ramped[r] != c->target[r];
    }
    for (int k = 0; c->ramps && k < s->N; k++)
        for (int r = 0; r < s->n_c; r++) {
            double end = c->goals ? c->goals[k * s->n_c + r] : c->target[r];
            double reach = (k + 1) * s->ramp[r] * s->dt;
            if (s->ramp[r] > 0.0)
                end = fmin(fmax(end, c->ramped[r] - reach), c->ramped[r] + reach);
            c->path[k * s->n_c + r] = end;
        }
#else
    memcpy(c->ramped, c->target, sizeof c->ramped);
#endif
}

/* How many whole samples ago a plan was made, and the share of one. */
static int samples_ago(const tg_controller *c, double *share)
{
    double samples = c->age_s / c->design->dt, whole = fmin(floor(samples + TG_SAME), c->design->N - 1.0);
    *share = fmin(samples - whole, 1.0);
    return (int)whole;
}

/* Between two samples what is planned is the mean of the two; the last sample of a plan stays. */
static double planned(const tg_controller *c, int at, double share, int j)
{
    int last = c->design->N - 1;
    double now = c->plan[(at < last ? at : last) * TG_NU + j];
    if (share <= TG_SAME)
        return now;
    return (1.0 - share) * now + share * c->plan[(at + 1 < last ? at + 1 : last) * TG_NU + j];
}

double tg_planned(const tg_controller *c, int k, int j)
{
    double share;
    int ago = samples_ago(c, &share);
    return planned(c, k + ago, share, j);
}

/* What of the plan to apply until the next call: who is called late will be called late again, so it is the mean
 * over as many seconds as have passed, at least its first sample. */
static void open_plan(const tg_controller *c, double *drive)
{
    const tg_design *s = c->design;
    double samples = fmin(fmax(c->slew_s / s->dt, 1.0), (double)s->N);
    for (int j = 0; j < TG_NU; j++) {
        double sum = 0.0;
        for (int k = 0; k < samples; k++)
            sum += fmin(samples - k, 1.0) * tg_planned(c, k, j);
        drive[j] = sum / samples;
    }
}

void tg_guess(const tg_controller *c, const double *last, double *guess)
{
    const tg_design *s = c->design;
    double share;
    int k = samples_ago(c, &share);
    for (int b = 0; b < s->n_b; b++, k += s->blocks[b - 1])
        for (int j = 0; j < TG_NU; j++) {
            double sum = 0.0;
            for (int at = 0; at < s->blocks[b]; at++)
                sum += c->has_plan ? planned(c, k + at, share, j) : 0.0;
            guess[b * TG_NU + j] = c->has_plan ? sum / s->blocks[b] : last[j];
        }
}

/* Whether a plan is another one than it was linearised along. */
static int has_moved(const tg_design *s, const double *guess, const double *plan)
{
    for (int i = 0; i < s->n_b * TG_NU; i++)
        if (fabs(plan[i] - guess[i]) > TG_STAYS * s->span[i % TG_NU])
            return 1;
    return 0;
}

static int optimise(tg_controller *c)
{
    const tg_design *s = c->design;
    int status, changes;
    double last[TG_NU], guess[TG_Q_N], d[TG_SOME(TG_ND)], on_u[TG_NU], on_y[TG_NY];
    const double *x = tg_now(c);
    tg_biases(c, on_u, d, on_y);
    for (int i = 0; i < TG_ND; i++)
        d[i] += c->d[i];
    for (int j = 0; j < TG_NU; j++)
        last[j] = fmin(fmax(c->u[j], s->lowest[j]), s->highest[j]);
    tg_guess(c, last, guess);
    status = tg_optimise(c, x, last, guess, d, c->ramped, c->side, on_y, on_u);
    changes = c->iterations;
    for (int n = 1; n < s->iterations && status == TG_QP_SOLVED && !s->linear && has_moved(s, guess, c->best); n++) {
        memcpy(guess, c->best, (size_t)s->n_b * TG_NU * sizeof(double));
        status = tg_optimise(c, x, last, guess, d, c->ramped, c->side, on_y, on_u);
        changes += c->iterations;
    }
    c->iterations = changes;
    return status;
}

/* Whether there is a plan to follow. */
static int is_young(const tg_controller *c)
{
    return c->has_plan && c->age_s <= c->design->patience_s * (1.0 + TG_SAME) && !c->on_pi;
}

static int time_is_up(const tg_controller *c) { return c->late && c->late(c->about); }

/* A share of a loop's target, less the reading. */
static double error_of(const tg_controller *c, int loop, double share)
{
    const tg_design *s = c->design;
    int r = s->loop_output[loop];
    return share * c->target[r] - c->y[s->controlled[r]];
}

/* One step of the PI controller, taken over without a bump: u = Kc (b r - y) + I,
 * I+ = I + dt Kc/Ti (r - y), but I where u is limited and this would take v further out. */
static void go_on_pi(tg_controller *c, double *drive)
{
    const tg_design *s = c->design;
    double wanted[TG_NU] = {0.0};
    for (int l = 0; l < s->n_loops && !c->on_pi; l++)
        c->integral[l] = c->u[s->loop_drive[l]] - s->Kc[l] * error_of(c, l, s->setpoint[l]);
    c->on_pi = 1;
    for (int l = 0; l < s->n_loops; l++)
        wanted[s->loop_drive[l]] = s->Kc[l] * error_of(c, l, s->setpoint[l]) + c->integral[l];
    for (int j = 0; j < TG_NU; j++) {
        double before = fmin(fmax(c->u[j], s->lowest[j]), s->highest[j]);
        double slew = s->slew[j] * (c->slew_s / s->dt);
        double low = fmax(s->lowest[j], before - slew), high = fmin(s->highest[j], before + slew);
        drive[j] = fmin(fmax(wanted[j], low), high);
    }
    for (int l = 0; l < s->n_loops; l++) {
        int j = s->loop_drive[l];
        double change = s->Kc[l] * error_of(c, l, 1.0), cut = drive[j] - wanted[j];
        if (cut * change > 0.0 || fabs(cut) <= TG_UNCUT * (s->highest[j] - s->lowest[j]))
            c->integral[l] += fmin(c->waited_s, c->slew_s) / s->Ti[l] * change;
    }
}

/* Follow the plan while it is recent; then PI, then off. */
static void follow(tg_controller *c, tg_move *move, int status, int advice)
{
    const tg_design *s = c->design;
    int unread = s->n_loops == 0;
    move->status = status;
    move->advice = advice;
    if (is_young(c)) {
        open_plan(c, move->drive);
        return;
    }
    for (int r = 0; r < s->n_c; r++)
        unread = unread || !isfinite(c->y[s->controlled[r]]);
    if (unread) {
        memcpy(move->drive, s->safe, sizeof move->drive);
        move->status = TG_OFF;
        return;
    }
    go_on_pi(c, move->drive);
    if (status == TG_FALLBACK_PLAN)
        move->status = TG_FALLBACK_PI;
}

/* For how long no controlled output was read [s], and whether one of them is not. */
static double unread_for(const tg_controller *c, int *one)
{
    double least = c->unread_s[0];
    *one = 0;
    for (int r = 0; r < c->design->n_c; r++) {
        least = fmin(least, c->unread_s[r]);
        *one = *one || c->unread_s[r] > 0.0;
    }
    return least;
}

static void follow_without_readings(tg_controller *c, tg_move *move, double seconds)
{
    move->status = TG_FALLBACK_PLAN;
    if (seconds <= c->design->patience_s * (1.0 + TG_SAME)) {
        if (is_young(c))
            open_plan(c, move->drive);
        else
            memcpy(move->drive, c->u, sizeof move->drive);
        return;
    }
    c->has_plan = 0;
    memcpy(move->drive, c->design->safe, sizeof move->drive);
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
    int outside = 0, unseen;
    double unread = unread_for(c, &unseen);
    move->status = TG_OK;
    move->advice = TG_ALL_WELL;
    memcpy(move->drive, s->safe, sizeof move->drive);
    if (!all_finite(c->target, s->n_c)) {
        move->status = TG_OFF;
        move->advice = TG_NO_TARGET;
        return;
    }
    if (unread > 0.0) {
        follow_without_readings(c, move, unread);
        return;
    }
    if (time_is_up(c)) {
        follow(c, move, TG_LATE, TG_TOO_LATE);
        return;
    }
    for (int j = 0; j < TG_NU; j++)
        outside = outside || c->u[j] < s->lowest[j] - TINY || c->u[j] > s->highest[j] + TINY;
    for (int r = 0; r < s->n_c; r++)
        c->lost[r] = c->unread_s[r] > s->patience_s * (1.0 + TG_SAME);
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
    open_plan(c, move->drive);
    if (outside) {
        move->status = TG_INFEASIBLE;
        move->advice = TG_OUT_OF_RANGE;
        return;
    }
    if (c->broken > TG_BREAKS * s->unit[c->breaks]) {
        move->status = c->broken > TG_BREAKS_FAR * s->unit[c->breaks] ? TG_INFEASIBLE : TG_OK;
        move->advice = TG_LIMIT_BREAKS;
        move->which = c->breaks;
        move->over = c->broken;
    } else if (time_is_up(c)) {
        move->status = TG_LATE;
        move->advice = TG_TOO_LATE;
    } else if (unseen) {
        move->status = TG_FALLBACK_PLAN;
        move->advice = TG_UNSEEN;
    }
}

/* Finite, in range, and within the slew limit; range wins over slew. */
static void keep_within(const tg_controller *c, double *u)
{
    const tg_design *s = c->design;
    for (int j = 0; j < TG_NU; j++) {
        double value = isfinite(u[j]) ? u[j] : s->safe[j];
        double before = fmin(fmax(c->u[j], s->lowest[j]), s->highest[j]);
        double slew = s->slew[j] * (c->slew_s / s->dt);
        value = fmin(fmax(value, before - slew), before + slew);
        u[j] = fmin(fmax(value, s->lowest[j]), s->highest[j]);
    }
}

static void set_pump(tg_move *move)
{
    move->pump = move->status != TG_OFF;
    for (int j = 0; j < TG_NU; j++)
        move->pump = move->pump || move->drive[j] != 0.0;
}

/* Take a call at this time with what was applied; readings that cannot be become NAN. */
static void receive(tg_controller *c, tg_time time_s, const double *y, const double *d, const double *applied,
                    double *clean_y, double *clean_d, double *did)
{
    note_call(c, time_s);
    for (int i = 0; i < TG_NY; i++)
        clean_y[i] = c->stale ? NAN : clean(c->design, y[i]);
    for (int i = 0; i < TG_ND; i++)
        clean_d[i] = clean_measured(c->design, i, d[i]);
    for (int j = 0; j < TG_NU; j++)
        did[j] = applied && isfinite(applied[j]) ? applied[j] : c->u[j];
}

/* The last move again, before the next one is due; its advice stays. */
static tg_move hold(tg_controller *c, double *y)
{
    tg_move move;
    memset(&move, 0, sizeof move);
    if (!c->stale)
        refine(c, y);
    memcpy(move.drive, c->u, sizeof move.drive);
    move.status = c->status;
    move.advice = c->advice == TG_ALL_WELL ? TG_TOO_EARLY : c->advice;
    set_pump(&move);
    return move;
}

tg_move tg_step(tg_controller *c, tg_time time_s, const double *y, const double *d, const double *applied,
                const double *target)
{
    tg_move move;
    double clean_y[TG_NY], clean_d[TG_SOME(TG_ND)], did[TG_NU], silent;
    int said, wrong;
    receive(c, time_s, y, d, applied, clean_y, clean_d, did);
    pass(c, did);
    c->moves = moves(c, target);
    if (!c->moves)
        return hold(c, clean_y);
    memset(&move, 0, sizeof move);
    said = absorb(c, clean_y, clean_d, did, &silent);
    if (said == TG_ALL_WELL && c->stale)
        said = TG_STALE;
    wrong = set_target(c, target);
    ramp(c);
    decide(c, &move);
    if (move.status == TG_OK && said != TG_ALL_WELL)
        move.advice = said; /* events of this sample before lasting conditions */
    if (wrong && move.status == TG_OK)
        move.status = TG_INFEASIBLE;
    if (wrong)
        move.advice = TG_BAD_TARGET;
    else if (move.advice == TG_ALL_WELL)
        move.advice = said;
    if (move.advice == TG_RESTARTED)
        move.over = silent;
    keep_within(c, move.drive);
    note_move(c, move.drive);
    set_pump(&move);
    c->status = move.status;
    c->advice = move.advice;
    return move;
}

tg_move tg_pause(tg_controller *c, tg_time time_s, const double *y, const double *d, const double *target)
{
    tg_move move;
    double clean_y[TG_NY], clean_d[TG_SOME(TG_ND)], did[TG_NU];
    memset(&move, 0, sizeof move);
    receive(c, time_s, y, d, NULL, clean_y, clean_d, did);
    memcpy(move.drive, c->design->neutral, sizeof move.drive);
    keep_within(c, move.drive);
    note_move(c, move.drive);
    for (int i = 0; i < TG_ND; i++)
        clean_d[i] = isfinite(clean_d[i]) ? clean_d[i] : c->d[i];
    start(c, clean_y, clean_d);
    set_target(c, target);
    take_sides(c);
    move.pump = 1; /* nobody would switch it on again */
    move.status = c->status = TG_OFF;
    move.advice = c->advice = TG_PUMP_OFF;
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
        "a target is missing or absurd: the last good one is kept",
        "no reading for too long: check the sensor",
        "the optimiser failed: the last plan goes on, then PI",
        "the drive that was applied is out of range: brought back",
        "a limit of an output will be broken: choose a nearer target",
        "a reading does not move though it should: is the sensor stuck?",
        "the deadline passed: the last plan goes on, then PI",
        "a jump of a reading stays: taken for an offset of the sensor",
        "a jump of the readings stays: the estimate was started again",
        "a controlled output has no usable reading: the model replaces it, then its drive rests; the others go on",
        "the pump is off: drive to zero until it runs",
    };
    return advice >= TG_ALL_WELL && advice <= TG_PUMP_OFF ? text[advice] : "?";
}
