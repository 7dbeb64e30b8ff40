/* Read what a controller is given, a sample a line, and answer what it does: status, drives, plan.
 *
 * A line: whether it starts at rest here, whether time is up, reading, measured disturbances, drives that were
 * applied, target; numbers as %a or "nan".
 */
#include "tg_design.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

static tg_controller controller;

static int time_is_up(void *about) { return *(const double *)about != 0.0; }

static int read_numbers(double *into, int n)
{
    char word[64];
    for (int i = 0; i < n; i++) {
        if (scanf("%63s", word) != 1)
            return 0;
        into[i] = (double)strtod(word, NULL);
    }
    return 1;
}

int main(void)
{
    tg_controller *c = &controller;
    double begins, late, y[TG_NY], d[TG_SOME(TG_ND)], applied[TG_NU], target[TG_NC];
    printf("ram %lu design %lu\n", (unsigned long)sizeof(tg_controller), (unsigned long)sizeof(tg_design));
    while (read_numbers(&begins, 1)) {
        tg_move move;
        if (!read_numbers(&late, 1) || !read_numbers(y, TG_NY) || !read_numbers(d, TG_ND) ||
            !read_numbers(applied, TG_NU) || !read_numbers(target, TG_NC))
            return 1;
        if (begins != 0.0)
            tg_reset(c, &tg_the_design, y, d);
        c->late = time_is_up;
        c->about = &late;
        move = tg_step(c, NAN, y, d, applied, target);
        printf("%d", move.status);
        for (int j = 0; j < TG_NU; j++)
            printf(" %a", move.drive[j]);
        for (int j = 0; c->has_plan && j < tg_the_design.N * TG_NU; j++)
            printf(" %a", tg_planned(c, j / TG_NU, j % TG_NU));
        printf("\n");
    }
    return 0;
}
