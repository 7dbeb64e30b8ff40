/* A quadratic program with few unknowns, by a dual active-set method; no malloc.
 *
 *   minimise    1/2 x'Hx + f'x + sum over soft rows price (s + 1/2 ratio s^2)
 *   subject to  lower <= x <= upper                   rows 0 .. n-1, hard
 *               lower <= x_i - x_(i-stride) <= upper  rows n .. 2n-1, hard; x_(negative) is 0
 *               lower - s <= A x <= upper + s, s >= 0 rows 2n .. 2n+s-1, soft
 *
 * The theory is at the head of tg_qp.c.
 */
#ifndef TG_QP_H
#define TG_QP_H

#include "tg_config.h"

#define TG_Q_N (TG_NB * TG_NU)
#define TG_Q_S (TG_NH * TG_NS)
#define TG_Q_M (2 * TG_Q_N + TG_Q_S)

enum tg_qp_status {
    TG_QP_SOLVED = 0,
    TG_QP_INFEASIBLE = 1,
    TG_QP_ITERATIONS = 2,
    TG_QP_NOT_CONVEX = 3,
    TG_QP_NOT_FINITE = 4,
    TG_QP_TIME = 5
};

typedef struct {
    /* the problem */
    int n, stride, s, per; /* per: soft rows in a sample */
    double H[TG_Q_N * TG_Q_N]; /* lower triangle, rows of TG_Q_N; its Cholesky factor afterwards */
    double f[TG_Q_N];
    double lower[TG_Q_M], upper[TG_Q_M]; /* beyond +-1e15: none */
    double A[TG_Q_S > 0 ? TG_Q_S * TG_Q_N : 1];
    int filled[TG_Q_S > 0 ? TG_Q_S : 1]; /* entries of a soft row before its trailing zeros */
    double price[TG_NS > 0 ? TG_NS : 1], at_end[TG_NS > 0 ? TG_NS : 1]; /* of a sample's soft rows; of the last one's */
    double ratio[TG_NS > 0 ? TG_NS : 1];
    int iteration_limit, kept; /* whether H (its factor), A and filled are those of the last solve */
    int (*late)(void *about); /* asked before every change of the working set: time is up; may be NULL */
    void *about;
    /* the answer */
    double x[TG_Q_N];
    int iterations; /* changes of the working set */
    /* the working set, kept from one solve to the next; rows may depend on one another, so that
     * it can be longer than there are unknowns and soft rows */
    int n_work;
    int row[TG_Q_M];
    signed char side[TG_Q_M];  /* +1 at the upper bound, -1 at the lower */
    signed char state[TG_Q_M]; /* 0 hard, 1 soft and kept, 2 soft and broken */
    double multiplier[TG_Q_M];
    /* room to work in */
    double c[TG_Q_N], weight[TG_Q_M];
    double normal[TG_Q_M * TG_Q_N]; /* side * L^-1 a of each row in the set */
    double fit[TG_Q_M * (TG_Q_M + 1) / 2], pivot[TG_Q_M]; /* LDL' of their products */
    double right[TG_Q_M], wanted[TG_Q_M];
    signed char in_set[TG_Q_M];
} tg_qp;

#ifdef __cplusplus
extern "C" {
#endif

/* Throw the working set away: the next solve starts cold. */
void tg_qp_forget(tg_qp *q);

/* Solve; return one of enum tg_qp_status. The working set is kept where it was solved; whoever gives another H or A
 * sets kept to 0 before, and it is 1 afterwards where there is a factor. */
int tg_qp_solve(tg_qp *q);

#ifdef __cplusplus
}
#endif

#endif
