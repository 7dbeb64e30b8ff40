/* Relays as drives, as thermogrip.mpc.design.relays has them. */
#include "tg_switches.h"
#include "tg_relays.h"

#include <math.h>

/* The share that is requested of a relay, below zero where the other sign is. */
static double share_of(const tg_relay *r, const double *drive)
{
    return isfinite(drive[r->drive]) ? drive[r->drive] / r->full : 0.0;
}

/* In how long relay i goes over if these drives stay. */
static double due_s(const tg_relay *r, const tg_switch *s, int i, const double *drive)
{
    const double share = share_of(r + i, drive);
    const tg_switch *opposite = r[i].opposite < 0 ? 0 : s + r[i].opposite;
    double due;
    if (s[i].on) {
        double paid = share < 1.0 ? fmax(s[i].owed_s, 0.0) / (1.0 - share) : INFINITY;
        return fmax(paid, r[i].on_s - s[i].since_s);
    }
    if (share <= 0.0 || (opposite && opposite->on))
        return INFINITY;
    due = fmax((0.5 * r[i].on_s - s[i].owed_s) / share, r[i].off_s - s[i].since_s);
    if (opposite)
        due = fmax(due, r[i].dead_s - opposite->since_s);
    return fmax(due, 0.0);
}

void tg_switches_reset(tg_switch *s, int n)
{
    for (int i = 0; i < n; i++) {
        s[i].on = s[i].stopped = 0;
        s[i].fresh = 1;
        s[i].owed_s = s[i].since_s = 0.0;
    }
}

void tg_switches_pass(const tg_relay *r, tg_switch *s, int n, const double *drive, double seconds)
{
    for (int i = 0; i < n; i++) {
        double share = s[i].stopped ? 0.0 : share_of(r + i, drive), least, most;
        s[i].since_s += seconds;
        if (s[i].on) {
            s[i].owed_s += (fmax(share, 0.0) - 1.0) * seconds;
            continue;
        }
        /* the bounds within which the mean is that of what is requested; the other sign takes back what is owed */
        least = share < 0.0 ? fmin(s[i].owed_s, 0.0) : -INFINITY;
        most = fmax(0.5 * r[i].on_s, s[i].fresh ? 0.0 : r[i].off_s) + TG_SHORTEST_S;
        s[i].owed_s = fmin(fmax(s[i].owed_s + share * seconds, least), most);
    }
}

double tg_switches_turn(const tg_relay *r, tg_switch *s, int n, const double *drive, int running)
{
    double next = INFINITY;
    for (int i = 0; i < n; i++) { /* one after the other: of two that are due one comes on, and the other waits */
        s[i].stopped = !running;
        if (running ? due_s(r, s, i, drive) > TG_NOW_S : !s[i].on)
            continue;
        s[i].on = !s[i].on;
        s[i].fresh = 0;
        s[i].since_s = 0.0;
        if (!running)
            s[i].owed_s = 0.0;
    }
    for (int i = 0; i < n && running; i++)
        next = fmin(next, due_s(r, s, i, drive));
    return next;
}
