/* Read states, one a line, and answer what the controller does there: status, drives, plan.
 *
 * A line: x, w, measured disturbances, drives, whether there is a plan, the plan, target and side of before,
 * reading, its disturbances, target, whether time is up, the time of before, where targets ramp; numbers as %a or
 * "nan".
 */
#include "tg_design.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

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
    double y[TG_NY], d[TG_SOME(TG_ND)], target[TG_NC], planned, late, time_s;
    double cold[TG_NY], room[TG_SOME(TG_ND)];
    for (int i = 0; i < TG_NY; i++)
        cold[i] = tg_the_design.ambient;
    for (int i = 0; i < TG_SOME(TG_ND); i++)
        room[i] = tg_the_design.usual_d[i];
    printf("ram %lu design %lu\n", (unsigned long)sizeof(tg_controller), (unsigned long)sizeof(tg_design));
    for (;;) {
        tg_move move;
        tg_reset(c, &tg_the_design, cold, room);
        memset(c->found_offset, 0, sizeof c->found_offset);
        if (!read_numbers(c->x, TG_NX))
            return 0;
        if (!read_numbers(c->w, TG_NW) || !read_numbers(c->d, TG_ND) || !read_numbers(c->u, TG_NU) ||
            !read_numbers(&planned, 1) || !read_numbers(c->plan, tg_the_design.N * TG_NU) ||
            !read_numbers(c->target, TG_NC) || !read_numbers(c->side, TG_NC) || !read_numbers(y, TG_NY) ||
            !read_numbers(d, TG_ND) || !read_numbers(target, TG_NC) || !read_numbers(&late, 1) ||
            !read_numbers(&time_s, 1) || !read_numbers(c->ramped, TG_NC))
            return 1;
        c->time_s = time_s;
        c->late = time_is_up;
        c->about = &late;
        c->fresh = 0;
        c->has_plan = planned != 0.0;
        memcpy(c->in_force, c->u, sizeof c->in_force);
        move = tg_step(c, NAN, y, d, NULL, target);
        printf("%d", move.status);
        for (int j = 0; j < TG_NU; j++)
            printf(" %a", move.drive[j]);
        for (int j = 0; c->has_plan && j < tg_the_design.N * TG_NU; j++)
            printf(" %a", tg_planned(c, j / TG_NU, j % TG_NU));
        printf("\n");
    }
}
