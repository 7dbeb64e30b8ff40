/* PI loops: see README.md. */
#ifndef TG_PI_H
#define TG_PI_H

#include "tg_pi_config.h" /* TG_NC outputs that have a target, TG_NU drives; tg_real */

#ifdef __cplusplus
extern "C" {
#endif

enum { TG_OK = 0, TG_FALLBACK_PLAN = 3, TG_OFF = 5 }; /* places among the statuses of every controller */

typedef struct {
    tg_real integral[TG_NC], begun[TG_NC], target[TG_NC], unread_s[TG_NC]; /* begun: NAN until there is a reading */
    tg_real u[TG_NU];                                                      /* the last move */
} tg_pi;

/* Begin at rest at readings y (NAN where lost) under drives u; NULL: no drive. */
void tg_pi_reset(tg_pi *c, const tg_real *y, const tg_real *u);

/* One sample: readings y and targets of TG_NC outputs, NAN where lost; the drives are in c->u.  Returns a status. */
int tg_pi_step(tg_pi *c, const tg_real *y, const tg_real *target);

#ifdef __cplusplus
}
#endif

#endif
