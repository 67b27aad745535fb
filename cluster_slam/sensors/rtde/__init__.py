"""Universal Robots' Real-Time Data Exchange: the wire, an emulated controller, and a guarded client. Read only.

Nothing here commands an arm: the client asks for outputs, and the emulator knows no inputs.
"""
