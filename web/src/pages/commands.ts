// Commands for a terminal, as this service needs them.

import { copyField } from './dom.ts';
import type { Session } from './session.ts';

/** A command of the program, with the address of the service and a token if it asks for one. */
export function commandField(session: Session, command: string): HTMLElement {
    const coordinator = `${location.protocol}//${location.hostname}:7420`;
    const token = session.caller.tokensRequired ? ' --token-file FILE' : '';
    return copyField('Command', `fathom ${command} --coordinator ${coordinator}${token}`);
}
