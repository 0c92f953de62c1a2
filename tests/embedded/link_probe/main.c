/* Runs the probe on the host: constructors, then 1000 cycles with the allocator sealed. */
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>

struct Probe;
struct Probe *delmpc_probe_new(void);
size_t delmpc_probe_memory(void);
double delmpc_probe_cycle(struct Probe *probe);

void delmpc_probe_panicked(void)
{
    fputs("panicked (memory asked for after construction?)\n", stderr);
    exit(2);
}

int main(void)
{
    struct Probe *probe = delmpc_probe_new();
    double a = 0.0;
    if (probe == NULL)
        return 1;
    for (int cycle = 0; cycle < 1000; cycle++)
        a = delmpc_probe_cycle(probe);
    printf("1000 cycles without the standard library, %zu bytes taken by constructors, A[0,0] = %.6f\n",
           delmpc_probe_memory(), a);
    return a == a ? 0 : 1;
}
