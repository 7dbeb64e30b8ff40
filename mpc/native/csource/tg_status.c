/* Whether controlled outputs are where their plans had them, and whether they swing about their targets: the rules of
 * mpc/estimator/arrival.py and oscillation.py. */
#include "tg_controller.h"

#include <math.h>
#include <string.h>

#define PI 3.14159265358979323846

/* ---- arrivals ---- */

static double allowed(const tg_controller *c) { return 2.0 * c->design->overshoot; }

void tg_forget_arrivals(tg_controller *c)
{
    for (int r = 0; r < TG_NC; r++) {
        tg_arrival *a = c->arrival + r;
        a->goal = a->error = NAN;
        a->due = a->nearest = INFINITY;
        a->late = 0.0;
        a->stayed = 0;
    }
    c->recedes = 0;
}

double tg_overdue(tg_controller *c)
{
    const tg_design *s = c->design;
    double worst = 0.0, over = 0.0;
    int other = 0;
    for (int r = 0; r < s->n_c; r++)
        other = other || !(c->ramped[r] == c->arrival[r].goal);
    if (other)
        tg_forget_arrivals(c);
    c->recedes = 0;
    for (int r = 0; r < s->n_c; r++) {
        tg_arrival *a = c->arrival + r;
        const int i = s->controlled[r];
        const double goal = c->ramped[r], error = c->y[i] - goal, zone = s->zone[r];
        const double near = fmax(allowed(c), TG_NEAR_SD * sqrt(s->R[i])), begun = isfinite(a->error) ? a->error : error;
        double off;
        int there, at = 0, is_away;
        a->goal = goal;
        a->error = isfinite(error) ? begun + TG_NEWEST_ERROR * (error - begun) : begun;
        off = fabs(a->error) - zone;
        a->stayed = off <= near ? a->stayed + 1 : 0;
        there = a->stayed >= TG_ARRIVAL_SAMPLES;
        a->due = there ? INFINITY : a->due - c->waited_s;
        a->late = there ? 0.0 : a->late + c->waited_s;
        while (at < s->N && !(fabs(c->y_best[at * TG_NY + i] - goal) - zone <= near))
            at++;
        if (at < s->N && off > near && isinf(a->due)) {
            a->due = TG_LATE_TIMES * s->dt * (at + 1) + TG_LATE_SAMPLES * s->dt;
            a->late = -s->dt * (at + 1);
        }
        is_away = off > near && fabs(error) - zone > near;
        a->nearest = isfinite(off) ? fmin(a->nearest, fmax(off, 0.0)) : a->nearest;
        c->recedes = c->recedes || (is_away && off > a->nearest + near);
        if (is_away && a->due < 0.0 && off / near > worst) {
            worst = off / near;
            over = fmax(a->late, 1e-9);
        }
    }
    return over;
}

/* ---- swings ---- */

static double least(const tg_controller *c, const tg_swing *q)
{
    return fmax(allowed(c), TG_NOISE_SD * sqrt(q->variance));
}

/* The half swings until now, the last one that is open too where it counts already, two on one side being one. */
static int counted(const tg_controller *c, const tg_swing *q, double longest, tg_half *found)
{
    const tg_half half = q->open;
    const double a = least(c, q), seconds = half.end - half.begin;
    int n = q->n;
    memcpy(found, q->half, (size_t)n * sizeof(tg_half));
    if (!(half.iae >= a * TG_SHORTEST_PERIOD * c->design->dt / PI && half.iae >= 2.0 / PI * a * seconds && q->arrived &&
          seconds <= longest))
        return n;
    if (n > 0 && found[n - 1].side == half.side) {
        found[n - 1].iae += half.iae;
        found[n - 1].end = half.end;
        return n;
    }
    found[n] = half;
    return n + 1;
}

static int rings(const tg_half *half, int n)
{
    return n >= TG_SWINGS && half[n - 1].iae >= TG_LAST_SWING * half[n - TG_SWINGS].iae;
}

static void note_noise(const tg_controller *c, tg_swing *q, double value)
{
    double *v = q->last;
    if (q->n_last == 4) {
        double fourth = v[0] - 4.0 * v[1] + 6.0 * v[2] - 4.0 * v[3] + value, most = allowed(c) * allowed(c);
        q->seen = q->seen < TG_NOISE_READINGS ? q->seen + 1 : TG_NOISE_READINGS;
        if (q->seen == TG_NOISE_READINGS)
            most = fmax(TG_SPIKE_VARIANCES * q->variance, most);
        q->variance += (fmin(fourth * fourth / 70.0, most) - q->variance) / q->seen;
        memmove(v, v + 1, 3 * sizeof *v);
        q->n_last = 3;
    }
    v[q->n_last++] = value;
}

/* Note an error so many seconds after the last; how many times its swing exceeds the least one, 0 where it does not
 * swing, and its period. */
static double note(const tg_controller *c, tg_swing *q, double error, double value, double longest, double *period)
{
    tg_half found[TG_SWINGS + 1];
    double sum = 0.0, seconds = 0.0, side;
    int n, first;
    q->now += c->waited_s;
    if (isfinite(error)) {
        note_noise(c, q, value);
        side = error > 0.0 ? 1.0 : error < 0.0 ? -1.0 : q->open.side;
        if (side != q->open.side) {
            n = counted(c, q, longest, found);
            first = n > TG_SWINGS ? n - TG_SWINGS : 0;
            q->n = n - first;
            memcpy(q->half, found + first, (size_t)q->n * sizeof(tg_half));
            q->arrived = q->arrived || q->open.side != 0.0;
            q->open.side = side;
            q->open.iae = 0.0;
            if (!q->n) /* of no half swing that is kept, no time need be told */
                q->now = c->waited_s;
            q->open.begin = q->now - c->waited_s;
        }
        q->open.iae += fabs(error) * c->waited_s;
        q->open.end = q->now;
        n = counted(c, q, longest, found);
        if (n > 0 && q->now - found[n - 1].end > 2.0 * (found[n - 1].end - found[n - 1].begin))
            q->n = 0;
    } else
        q->n_last = 0;
    n = counted(c, q, longest, found);
    if (!rings(found, n) && !rings(q->half, q->n))
        return 0.0;
    first = n > TG_SWINGS ? n - TG_SWINGS : 0;
    for (int k = first; k < n; k++) {
        sum += found[k].iae;
        seconds += found[k].end - found[k].begin;
    }
    *period = 2.0 * (found[n - 1].begin - found[first].begin) / (n - first - 1);
    return 0.5 * PI * sum / seconds / least(c, q);
}

double tg_swings(tg_controller *c)
{
    const tg_design *s = c->design;
    double most = 0.0, found = 0.0;
    int other = 0;
    for (int r = 0; r < s->n_c; r++)
        other = other || !(c->ramped[r] == c->swing[r].goal);
    for (int r = 0; r < s->n_c; r++) {
        tg_swing *q = c->swing + r;
        const double goal = c->ramped[r], value = c->y[s->controlled[r]];
        double error = value - goal, period = 0.0, by;
        if (other) {
            q->goal = goal;
            q->now = 0.0;
            q->arrived = q->n = 0;
            memset(&q->open, 0, sizeof q->open);
        }
        if (s->zone[r] > 0.0 && isfinite(error))
            error = (error > 0.0 ? 1.0 : -1.0) * fmax(0.0, fabs(error) - s->zone[r]);
        by = note(c, q, error, value, s->longest[r], &period);
        if (by > most) {
            most = by;
            found = period;
        }
    }
    return found;
}
