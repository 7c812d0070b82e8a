/* Preloaded into linux.uml by `run`. UML of Linux 6.1 sets a process's floating point and vector
   registers from a buffer of 2696 bytes. The machine's kernel takes them only whole, which with AMX
   is 11008 bytes, and says EFAULT to less: UML panics with "ptrace set fp regs failed".

   So what UML has is laid over what the process has, and all of it is set. The rest belongs to
   registers that no process in UML can use: the machine's kernel gives AMX only to a process that
   asks for it, and UML does not pass that question on. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

static long (*next_ptrace)(enum __ptrace_request, ...);

/* Not at the first call: the stacks in UML are small. */
__attribute__((constructor)) static void find_next(void)
{
    next_ptrace = (long (*)(enum __ptrace_request, ...))dlsym(RTLD_NEXT, "ptrace");
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *), *data = va_arg(arguments, void *);
    va_end(arguments);

    /* UML calls from one thread, and not from its signal handlers. */
    static char whole[65536] __attribute__((aligned(64)));
    static size_t needed;
    if (request == PTRACE_SETREGSET && (unsigned long)address == NT_X86_XSTATE) {
        const struct iovec *part = data;
        struct iovec all = {whole, sizeof whole};
        /* The size is the machine's: where the buffer is enough, one look is all that is added. */
        if ((needed == 0 || part->iov_len < needed)
            && next_ptrace(PTRACE_GETREGSET, pid, address, &all) == 0) {
            needed = all.iov_len;
            if (part->iov_len < needed) {
                memcpy(whole, part->iov_base, part->iov_len);
                return next_ptrace(request, pid, address, &all);
            }
        }
    }
    return next_ptrace(request, pid, address, data);
}
