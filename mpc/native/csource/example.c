/* A closed loop of the controller with its own model, from rest to a target. */
#include "tg_design.h"
#include "tg_model.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

static tg_controller controller;

static void look(const double *x, double *y)
{
    for (int i = 0; i < TG_NY; i++) {
        y[i] = tg_the_design.y0[i] + tg_the_design.offset[i];
        for (int j = 0; j < TG_NX; j++)
            y[i] += tg_the_design.C[i * TG_NX + j] * x[j];
    }
}

int main(void)
{
    const tg_design *s = &tg_the_design;
    double x[TG_NX], next[TG_NX], y[TG_NY], d[TG_SOME(TG_ND)], target[TG_NC];
    for (int i = 0; i < TG_SOME(TG_ND); i++)
        d[i] = s->usual_d[i];
    memcpy(x, s->rest, sizeof x);
    look(x, y);
    for (int r = 0; r < TG_NC; r++)
        target[r] = y[s->controlled[r]] + 5.0;
    tg_reset(&controller, s, y, d);
    for (int k = 0; k < 200; k++) {
        tg_move move = tg_step(&controller, NAN, y, d, NULL, target);
        if (k % 20 == 0)
            printf("%7.1f s  output %7.3f  target %6.2f  drive %8.4f  %s\n", k * s->dt, y[s->controlled[0]],
                   target[0], move.drive[0], tg_status_text(move.status));
        for (int part = 0; part < s->sub; part++) {
            tg_model_next(x, move.drive, d, s->k, next);
            memcpy(x, next, sizeof x);
        }
        look(x, y);
    }
    return 0;
}
