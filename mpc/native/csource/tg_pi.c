/* PI loops with setpoint weight and conditional integration; as thermogrip.mpc.controllers.pi has them. */
#include "tg_pi.h"

#include <math.h>

static int plausible(tg_real value) { return value >= TG_COLDEST && value <= TG_HOTTEST; } /* NAN is not */

static tg_real within(tg_real value, tg_real low, tg_real high)
{
    return value < low ? low : value > high ? high : value;
}

void tg_pi_reset(tg_pi *c, const tg_real *y, const tg_real *u)
{
    for (int j = 0; j < TG_NU; j++)
        c->u[j] = u ? u[j] : within((tg_real)0, tg_lowest[j], tg_highest[j]);
    int whole = 1;
    for (int i = 0; i < TG_NC; i++)
        whole = whole && plausible(y[i]);
    for (int i = 0; i < TG_NC; i++) {
        c->begun[i] = c->target[i] = plausible(y[i]) ? y[i] : (tg_real)NAN;
        c->integral[i] = whole ? c->u[tg_drive[i]] : (tg_real)0;
        c->unread_s[i] = (tg_real)0;
    }
}

/* Move the drives to these values, inside their range and slew; range wins over slew. */
static void move(tg_pi *c, const tg_real *wanted)
{
    for (int j = 0; j < TG_NU; j++) {
        tg_real before = within(c->u[j], tg_lowest[j], tg_highest[j]);
        tg_real slewed = within(wanted[j], before - tg_slew[j], before + tg_slew[j]);
        c->u[j] = within(slewed, tg_lowest[j], tg_highest[j]);
    }
}

int tg_pi_step(tg_pi *c, const tg_real *y, const tg_real *target)
{
    tg_real wanted[TG_NU], error[TG_NC];
    int have_targets = 1, seen = 0, lost = 0;
    for (int i = 0; i < TG_NC; i++) {
        if (plausible(target[i]))
            c->target[i] = target[i];
        have_targets = have_targets && !isnan(c->target[i]);
    }
    for (int i = 0; i < TG_NC; i++) {
        int usable = have_targets && plausible(y[i]);
        c->unread_s[i] = usable ? (tg_real)0 : c->unread_s[i] + TG_DT;
        error[i] = usable ? c->target[i] - y[i] : (tg_real)NAN;
        seen += usable;
        lost += c->unread_s[i] > TG_PATIENCE;
    }
    if (!seen) { /* the drives are held for as long as patience lasts */
        if (lost == TG_NC)
            move(c, tg_safe);
        return lost == TG_NC ? TG_OFF : TG_FALLBACK_PLAN;
    }
    for (int j = 0; j < TG_NU; j++)
        wanted[j] = (tg_real)0;
    for (int i = 0; i < TG_NC; i++) {
        int j = tg_drive[i];
        if (plausible(y[i]) && isnan(c->begun[i]))
            c->begun[i] = y[i];
        if (isnan(error[i]))
            wanted[j] = c->unread_s[i] > TG_PATIENCE ? tg_safe[j] : c->u[j];
        else
            wanted[j] = tg_Kc[i] * (error[i] - ((tg_real)1 - tg_setpoint[i]) * (c->target[i] - c->begun[i])) + c->integral[i];
    }
    move(c, wanted);
    for (int i = 0; i < TG_NC; i++) { /* the integrator stands while the limit keeps the drive */
        int j = tg_drive[i];
        tg_real change = tg_Kc[i] * error[i], cut = c->u[j] - wanted[j];
        if (!isnan(error[i]) && (cut * change > (tg_real)0 || fabs((double)cut) <= (double)tg_uncut[j]))
            c->integral[i] += TG_DT * tg_Kc[i] / tg_Ti[i] * error[i];
    }
    return seen == TG_NC ? TG_OK : TG_FALLBACK_PLAN;
}
