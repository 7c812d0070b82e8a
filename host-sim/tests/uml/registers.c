/* Run by `selftest` in UML: whether vector registers are as they were after a signal's handler has
   changed them. UML saves and sets them for that as it does between two threads. Not the last register: on a processor
   that has nothing behind it, its last bytes are what a buffer that is too small loses (poor_host.c). */
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/time.h>

static volatile sig_atomic_t handled;
static const double others[4] = {-1, -2, -3, -4};
static int avx;

static void change(int signal)
{
    (void)signal;
    if (avx)
        __asm__ volatile("vmovupd %0, %%ymm14" : : "m"(others) : "xmm14");
    else
        __asm__ volatile("movupd %0, %%xmm14" : : "m"(others) : "xmm14");
    handled += 1;
}

int main(void)
{
    const struct itimerval often = {{0, 10000}, {0, 10000}};
    const double before[4] = {1, 2, 3, 4};
    avx = __builtin_cpu_supports("avx");
    signal(SIGALRM, change);
    setitimer(ITIMER_REAL, &often, NULL);
    while (handled < 20) {
        double after[4] = {1, 2, 3, 4};
        long turns = 1000000;
        if (avx)
            __asm__ volatile("vmovupd %2, %%ymm14; 1: dec %0; jnz 1b; vmovupd %%ymm14, %1; vzeroupper"
                             : "+r"(turns), "=m"(after) : "m"(before) : "cc", "xmm14", "memory");
        else
            __asm__ volatile("movupd %2, %%xmm14; 1: dec %0; jnz 1b; movupd %%xmm14, %1"
                             : "+r"(turns), "+m"(after) : "m"(before) : "cc", "xmm14", "memory");
        if (memcmp(before, after, sizeof before) != 0) {
            printf("%g %g %g %g after %d signals\n", after[0], after[1], after[2], after[3], (int)handled);
            return 1;
        }
    }
    return 0;
}
